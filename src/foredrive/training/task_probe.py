"""Training of task heads on kept volumes of a frozen world model."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.models.tasks.heads import TaskHeads
from foredrive.scene import Belief, Boxes, Task, VoxelSpec, WorldModel
from foredrive.scene.record import Record
from foredrive.scene.task_truth import TaskTruth
from foredrive.training.task_losses import TaskWeights, task_losses


@dataclass(frozen=True)
class TaskVolumes(Record):
    """The volumes of the belief about now as the heads of some tasks read them."""

    volume: Float[Tensor, "*b V D Z Y X"]
    """The distinct volumes."""
    tasks: tuple[Task, ...]
    index: tuple[int, ...]
    """For each of `tasks`, its volume."""

    def by_task(self) -> dict[Task, Float[Tensor, "b D Z Y X"]]:
        """Return the volume of each task. Tasks that share a volume get the same tensor."""
        distinct = self.volume.unbind(dim=1)
        return {task: distinct[number] for task, number in zip(self.tasks, self.index, strict=True)}


@dataclass(frozen=True)
class TaskExample(Record):
    """Volumes and truth at now: one item of a probe's training."""

    volumes: TaskVolumes
    boxes: Boxes
    boxes_valid: Bool[Tensor, "*b"]
    """Whether the log is annotated at now."""
    truth: TaskTruth
    key: tuple[str, ...]


def task_volumes(world: WorldModel, belief: Belief, tasks: tuple[Task, ...]) -> TaskVolumes:
    """Return the volumes of a belief as the heads of some tasks read them."""
    distinct: list[Tensor] = []
    index = []
    for task in tasks:
        volume = world.volume_for(belief, task)
        same = [number for number, other in enumerate(distinct) if other is volume]
        index.append(same[0] if same else len(distinct))
        distinct += [] if same else [volume]
    return TaskVolumes(torch.stack(distinct, dim=1), tasks, tuple(index))


class ProbeObjective(nn.Module):
    """The mapping from kept volumes and truth to the losses of the heads.

    Args:
        heads: the trained modules.
        spec: grid of the volumes.
        weights: weights of the losses.
        class_weight: weight of each class of semantic voxels; None weighs all equally.
    """

    def __init__(
        self,
        heads: TaskHeads,
        spec: VoxelSpec,
        weights: TaskWeights,
        class_weight: Float[Tensor, "C"] | None = None,
    ) -> None:
        super().__init__()
        self.heads, self.spec, self.weights = heads, spec, weights
        self.class_weight: Tensor | None
        self.register_buffer("class_weight", class_weight, persistent=False)

    def forward(self, example: TaskExample, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        """Return losses by name; "loss" is minimised. Nothing is drawn from the generator."""
        output = self.heads(example.volumes.by_task())
        return task_losses(
            output,
            example.boxes,
            example.boxes_valid,
            example.truth,
            self.spec,
            self.class_weight,
            self.weights,
        )
