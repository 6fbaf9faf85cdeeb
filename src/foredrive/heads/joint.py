"""Training of task heads together with the world model and the planner."""

from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.heads.heads import HeadOutput, TaskHeadsConfig
from foredrive.heads.losses import TaskWeights, task_losses
from foredrive.scene import Boxes, Clip, Example, VoxelSpec


@dataclass(frozen=True)
class JointTasks:
    """Heads that are trained end to end in fine-tuning, and the weights of their losses."""

    heads: TaskHeadsConfig
    weights: TaskWeights = field(default_factory=TaskWeights)
    weight: float = 0.5
    """Weight of the sum of the heads' losses beside the other losses of the stage."""


class TaskTerms(nn.Module):
    """The losses of an agent's heads as terms of an objective.

    Args:
        config: weights.
        spec: grid of the volumes.
        class_weight: weight of each class of semantic voxels; None weighs all equally.
    """

    def __init__(
        self, config: JointTasks, spec: VoxelSpec, class_weight: Float[Tensor, "C"] | None = None
    ) -> None:
        super().__init__()
        self.config, self.spec = config, spec
        self.class_weight: Tensor | None
        self.register_buffer("class_weight", class_weight, persistent=False)

    def forward(self, output: HeadOutput, example: Example) -> dict[str, Float[Tensor, ""]]:
        """Return the losses by name, as "task_NAME", and their weighted sum as "tasks".

        Raises:
            InputError: the example has no truth of the tasks.
        """
        if example.truth is None:
            raise InputError(f"{example.key[0]}: heads are trained, but the clip has no truth of their tasks")
        clip = example.clip
        losses = task_losses(
            output,
            boxes_now(clip),
            clip.boxes_valid[:, clip.now],
            example.truth,
            self.spec,
            self.class_weight,
            self.config.weights,
            self.config.heads.frames,
        )
        total = losses.pop("loss")
        return {f"task_{name}": value for name, value in losses.items()} | {
            "tasks": self.config.weight * total
        }


def boxes_now(clip: Clip) -> Boxes:
    """Return the boxes at now, of an unbatched clip or of a batch."""
    return clip.boxes.map_tensors(lambda tensor: tensor.select(clip.t_s.dim() - 1, clip.now))
