"""Zero-shot classification of views by texts (Radford et al. 2021, section 3.1)."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.search.towers import PROMPTS, Towers, embed_prompt, unit


def class_vectors(
    towers: Towers, classes: Mapping[str, Sequence[str]], templates: Sequence[str] = PROMPTS
) -> Float[Tensor, "C D"]:
    """Return a unit vector per class: the mean direction of its texts, each in several wordings.

    Args:
        classes: texts by name, such as {"night": ("at night", "in the dark"), "day": ("by day",)}.
        templates: wordings with one {} for the text.

    Raises:
        InputError: a text is empty.
    """
    return torch.stack(
        [
            unit(torch.stack([embed_prompt(towers, text, templates) for text in texts]).mean(0))
            for texts in classes.values()
        ]
    )


def classify(embeddings: Float[Tensor, "n D"], classes: Float[Tensor, "C D"]) -> Int[Tensor, "n"]:
    """Return the class with the nearest direction for each embedding of an image or sweep."""
    return (unit(embeddings) @ classes.T).argmax(-1)
