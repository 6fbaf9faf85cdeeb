"""Task prompts: the text encoding of a task tells the features which task they serve (§3.3)."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.models.driveworld.planes import VectorToPlane, VectorToPlaneConfig
from foredrive.models.text_encoder import TextEncoder

PROMPTS = {
    "occupancy": "The task is to predict the 3D occupancy of the current scene.",
    "forecast": "The task is to predict the 3D occupancy of the future scene.",
    "plan": "The task is to plan the path that the ego vehicle will drive.",
}
"""Prompts by the names of the tasks. The first one is from the paper."""


@dataclass(frozen=True, kw_only=True)
class PromptConfig:
    """Sizes of a `TaskPrompt`."""

    expand: VectorToPlaneConfig
    encoding: int
    """Width of the output of the text encoder."""
    text_encoder: str
    """Name or folder of the text encoder. Needed only once, when training starts from scratch."""


def encode_prompts(config: PromptConfig) -> Float[Tensor, "P E"]:
    """Return the encoding of every prompt in `PROMPTS`, in order.

    Raises:
        InputError: the text encoder cannot be loaded, or its output has another width.
    """
    encoded: Tensor = TextEncoder(config.text_encoder)(list(PROMPTS.values()))
    if encoded.shape[1] != config.encoding:
        raise InputError(
            f"the text encoder {config.text_encoder!r} returns {encoded.shape[1]} numbers per sentence, but "
            f"model.prompt.encoding is {config.encoding}"
        )
    return encoded.detach()


class TaskPrompt(nn.Module):
    """The plane q(g(p)): the frozen encoding of a prompt, expanded by AdaIN and convolutions.

    The text encoder runs once, when the model is built. Its encodings are part of the weights, so a trained
    model does not need it.

    Args:
        config: sizes.
        encodings: g(p) of each prompt.
        size_yx: size of the plane.
    """

    encodings: Tensor

    def __init__(
        self, config: PromptConfig, encodings: Float[Tensor, "P E"], size_yx: tuple[int, int]
    ) -> None:
        super().__init__()
        self.tasks = tuple(PROMPTS)
        self.register_buffer("encodings", encodings)
        self.expand = VectorToPlane(config.expand, vector=config.encoding, size_yx=size_yx)

    def forward(self, task: str, batch: int) -> Float[Tensor, "b C Y X"]:
        """Return the plane of one task."""
        encoding = self.encodings[self.tasks.index(task)]
        return self.expand(encoding[None]).expand(batch, -1, -1, -1)
