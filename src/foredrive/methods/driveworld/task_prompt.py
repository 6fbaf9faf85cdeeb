"""Task prompts: the text encoding of a task tells the features which task they serve (§3.3)."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.methods.blocks.text_encoder import TextEncoder
from foredrive.methods.driveworld.planes import VectorToPlane, VectorToPlaneConfig

Prompt = Literal["occupancy", "forecast", "planning", "detection", "tracking", "map", "motion"]
"""A task, or "forecast": the occupancy of an imagined key frame, which the dynamics are trained with."""

PROMPTS: dict[Prompt, str] = {
    "occupancy": "The task is to predict the 3D occupancy of the current scene.",
    "forecast": "The task is to predict the 3D occupancy of the future scene.",
    "planning": "The task is to plan the path that the ego vehicle will drive.",
    "detection": "The task is to detect the 3D bounding boxes of all objects around the ego vehicle.",
    "tracking": "The task is to track the objects around the ego vehicle over time.",
    "map": "The task is to map the lanes, crossings and road boundaries around the ego vehicle.",
    "motion": "The task is to forecast the motion of the objects around the ego vehicle.",
}
"""Sentences by the names of the prompts. The first one is from the paper."""

FIRST_PROMPTS: tuple[Prompt, ...] = ("occupancy", "forecast", "planning")
"""Prompts of models that were trained before the other tasks had a prompt."""

_STAND_IN: dict[Prompt, Prompt] = {
    "detection": "occupancy",
    "tracking": "occupancy",
    "map": "occupancy",
    "motion": "forecast",
}
"""The prompt under which a model reads a task that it has no prompt for."""


@dataclass(frozen=True, kw_only=True)
class PromptConfig:
    """Sizes of a `TaskPrompt`."""

    expand: VectorToPlaneConfig
    encoding: int
    """Width of the output of the text encoder."""
    text_encoder: str
    """Name or folder of the text encoder. Needed only once, when training starts from scratch."""
    prompts: tuple[Prompt, ...] = FIRST_PROMPTS
    """Prompts that the model knows, in the order of their encodings. A task without a prompt is read under a
    near one."""


def encode_prompts(config: PromptConfig) -> Float[Tensor, "P E"]:
    """Return the encoding of every prompt that the model knows, in order.

    Raises:
        InputError: the text encoder cannot be loaded, or its output has another width.
    """
    encoded: Tensor = TextEncoder(config.text_encoder)([PROMPTS[name] for name in config.prompts])
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
        self.prompts = config.prompts
        self.register_buffer("encodings", encodings)
        self.expand = VectorToPlane(config.expand, vector=config.encoding, size_yx=size_yx)

    def forward(self, prompt: Prompt, batch: int) -> Float[Tensor, "b C Y X"]:
        """Return the plane of one prompt, or of the near one that the model knows."""
        prompt_name = prompt if prompt in self.prompts else _STAND_IN[prompt]
        encoding = self.encodings[self.prompts.index(prompt_name)]
        # The plane depends on the prompt alone, so it is computed once for the batch
        return self.expand(encoding[None]).expand(batch, -1, -1, -1)
