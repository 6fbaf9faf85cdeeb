"""Task prompts: what a text encoder makes of a task tells the features what they are for (§3.3)."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.models.driveworld.planes import VectorToPlane

PROMPTS = {
    "occupancy": "The task is to predict the 3D occupancy of the current scene.",
    "forecast": "The task is to predict the 3D occupancy of the future scene.",
    "plan": "The task is to plan the path that the ego vehicle will drive.",
}
"""By the names that heads ask for; the first is the paper's."""


class TaskPrompt(nn.Module):
    """q(g(p)): a prompt's frozen encoding, expanded to a plane by AdaIN and convolutions.

    The text encoder runs once, when the model is built; its encodings are part of the weights, so that a
    trained model needs it no more.

    Args:
        encodings: g(p) by the name of the task.
        widths: channels of the steps of the expansion, the last those of the plane.
        size_yx: of the plane.
    """

    encodings: Tensor

    def __init__(
        self, encodings: Mapping[str, Float[Tensor, "E"]], widths: Sequence[int], size_yx: tuple[int, int]
    ) -> None:
        super().__init__()
        self.tasks = tuple(encodings)
        self.register_buffer("encodings", torch.stack([encodings[task].detach() for task in self.tasks]))
        self.expand = VectorToPlane(self.encodings.shape[1], widths, size_yx)

    def forward(self, task: str, batch: int) -> Float[Tensor, "b C Y X"]:
        """The plane of one task."""
        encoding = self.encodings[self.tasks.index(task)]
        return self.expand(encoding[None]).expand(batch, -1, -1, -1)
