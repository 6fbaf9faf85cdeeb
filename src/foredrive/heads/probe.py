"""Training of task heads on kept volumes of a frozen world model."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor, nn

from foredrive.data.augmentation import mirrored_boxes, mirrored_pose
from foredrive.data.truth.mirrored import mirrored_truth
from foredrive.heads.heads import TaskHeads, TaskVolume, volumes_of
from foredrive.heads.losses import TaskWeights, task_losses
from foredrive.scene import Belief, Boxes, Task, VoxelSpec, WorldModel
from foredrive.scene.record import Record
from foredrive.scene.task_truth import TaskTruth


@dataclass(frozen=True)
class TaskVolumes(Record):
    """The volumes of the belief about now as the heads of some tasks read them."""

    volume: Float[Tensor, "*b V D Z Y X"]
    """The distinct volumes."""
    tasks: tuple[Task, ...]
    index: tuple[int, ...]
    """For each of `tasks`, its volume."""
    past: Float[Tensor, "*b D Z Y X"] | None = None
    """The volume one key frame earlier, in its own ego frame, of world models that keep it."""
    T_past_now: Float[Tensor, "*b 4 4"] | None = None
    """The ego frame at now -> the ego frame of `past`."""
    later: Float[Tensor, "*b K D Z Y X"] | None = None
    """Volumes of K imagined key frames, each in its own ego frame, for heads that read them."""
    T_now_later: Float[Tensor, "*b K 4 4"] | None = None
    """The ego frames of these -> the ego frame at now."""

    def by_task(self) -> dict[Task, TaskVolume]:
        """Return the volume of each task. Tasks that share a volume get the same record."""
        others = (self.past, self.T_past_now, self.later, self.T_now_later)
        distinct = [TaskVolume(now, *others) for now in self.volume.unbind(dim=1)]
        return {task: distinct[number] for task, number in zip(self.tasks, self.index, strict=True)}


@dataclass(frozen=True)
class TaskExample(Record):
    """Volumes and truth at now: one item of a probe's training."""

    volumes: TaskVolumes
    boxes: Boxes
    boxes_valid: Bool[Tensor, "*b"]
    """Whether the log is annotated at now."""
    truth: TaskTruth
    T_world_ego: Float64[Tensor, "*b 4 4"]
    """Pose at now."""
    key: tuple[str, ...]


def task_volumes(world: WorldModel, belief: Belief, tasks: tuple[Task, ...], later: int = 0) -> TaskVolumes:
    """Return the volumes of a belief about now as the heads of some tasks read them.

    Arguments and errors are those of `volumes_of`.
    """
    # Equal volumes are kept once; `index` says which one each task reads
    read = volumes_of(world, belief, tasks, later)
    distinct = list({id(volume): volume for volume in read.values()}.values())
    index = tuple(next(n for n, other in enumerate(distinct) if other is read[task]) for task in tasks)
    first = distinct[0]
    return TaskVolumes(
        torch.stack([volume.now for volume in distinct], dim=1),
        tasks,
        index,
        first.past,
        first.T_past_now,
        first.later,
        first.T_now_later,
    )


def mirrored_item(example: TaskExample, chosen: Bool[Tensor, "b"]) -> TaskExample:
    """Return a batch in which the chosen items are mirrored in the x-z plane of the ego vehicle.

    Volumes are mirrored as they are: nearly what a world model sees that was trained on mirrored clips.
    """
    volumes = example.volumes
    past, T_past_now = volumes.past, volumes.T_past_now
    if past is not None and T_past_now is not None:
        past, T_past_now = _flipped(past, chosen), mirrored_pose(T_past_now, chosen, axis=1)
    later, T_now_later = volumes.later, volumes.T_now_later
    if later is not None and T_now_later is not None:
        later = _flipped(later, chosen)
        T_now_later = mirrored_pose(T_now_later, chosen, axis=1)
    volumes = replace(volumes, later=later, T_now_later=T_now_later)
    volumes = replace(volumes, volume=_flipped(volumes.volume, chosen), past=past, T_past_now=T_past_now)
    return replace(
        example,
        volumes=volumes,
        boxes=mirrored_boxes(example.boxes, chosen),
        T_world_ego=mirrored_pose(example.T_world_ego, chosen, axis=1),
        truth=mirrored_truth(example.truth, chosen),
    )


# Mirroring in the x-z plane reverses the order of the cells along y
def _flipped(volume: Float[Tensor, "b *n Y X"], chosen: Bool[Tensor, "b"]) -> Tensor:
    flipped = volume.clone()
    flipped[chosen] = volume[chosen].flip(-2)
    return flipped


class ProbeObjective(nn.Module):
    """The mapping from kept volumes and truth to the losses of the heads.

    Args:
        heads: the trained modules.
        spec: grid of the volumes.
        weights: weights of the losses.
        class_weight: weight of each class of semantic voxels; None weighs all equally.
        mirror: probability that left and right of an item are exchanged.
    """

    def __init__(
        self,
        heads: TaskHeads,
        spec: VoxelSpec,
        weights: TaskWeights,
        class_weight: Float[Tensor, "C"] | None = None,
        mirror: float = 0.0,
    ) -> None:
        super().__init__()
        self.heads, self.spec, self.weights, self.mirror = heads, spec, weights, mirror
        self.class_weight: Tensor | None
        self.register_buffer("class_weight", class_weight, persistent=False)

    def forward(self, example: TaskExample, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        """Return losses by name; "loss" is minimised. The generator draws the items to mirror."""
        frames = self.heads.config.frames
        if self.mirror > 0:
            # One draw for each sequence
            drawn = torch.rand(len(example.boxes_valid) // frames, generator=generator) < self.mirror
            chosen = drawn.repeat_interleave(frames)  # all frames of a sequence, or none
            example = mirrored_item(example, chosen.to(example.boxes_valid.device))
        steps = self.heads.config.steps(example.T_world_ego)
        output = self.heads(example.volumes.by_task(), steps)
        return task_losses(
            output,
            example.boxes,
            example.boxes_valid,
            example.truth,
            self.spec,
            self.class_weight,
            self.weights,
            frames,
        )
