"""Task prompts: what a text encoder makes of a task tells the features what they are for (§3.3)."""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.models.driveworld.planes import VectorToPlane
from foredrive.models.text_encoder import TextEncoder

PROMPTS = {
    "occupancy": "The task is to predict the 3D occupancy of the current scene.",
    "forecast": "The task is to predict the 3D occupancy of the future scene.",
    "plan": "The task is to plan the path that the ego vehicle will drive.",
}
"""By the names that heads ask for; the first is the paper's."""


@dataclass(frozen=True, kw_only=True)
class PromptConfig:
    """Sizes of a `TaskPrompt`."""

    widths: tuple[int, ...]
    """Channels of the steps of the expansion, the last those of the plane."""
    encoding: int
    """Width of the text encoder's output."""
    text_encoder: str
    """By name or folder; needed once, by training from scratch."""


def encode_prompts(config: PromptConfig) -> Float[Tensor, "P E"]:
    """Return the encoding of every prompt in `PROMPTS`, in their order.

    Raises:
        InputError: the text encoder cannot be loaded, or its output has another width.
    """
    encoded: Tensor = TextEncoder(config.text_encoder)(list(PROMPTS.values()))
    if encoded.shape[1] != config.encoding:
        raise InputError(
            f"the text encoder {config.text_encoder!r} makes {encoded.shape[1]} numbers of a sentence, the "
            f"recipe has {config.encoding}"
        )
    return encoded.detach()


class TaskPrompt(nn.Module):
    """q(g(p)): a prompt's frozen encoding, expanded to a plane by AdaIN and convolutions.

    The text encoder runs once, when the model is built; its encodings are part of the weights, so that a
    trained model needs it no more.

    Args:
        encodings: g(p) of each prompt.
        widths: channels of the steps of the expansion, the last those of the plane.
        size_yx: of the plane.
    """

    encodings: Tensor

    def __init__(
        self, encodings: Float[Tensor, "P E"], widths: Sequence[int], size_yx: tuple[int, int]
    ) -> None:
        super().__init__()
        self.tasks = tuple(PROMPTS)
        self.register_buffer("encodings", encodings)
        self.expand = VectorToPlane(encodings.shape[1], widths, size_yx)

    def forward(self, task: str, batch: int) -> Float[Tensor, "b C Y X"]:
        """The plane of one task."""
        encoding = self.encodings[self.tasks.index(task)]
        return self.expand(encoding[None]).expand(batch, -1, -1, -1)
