"""Judge whether a text is about anything that an index shows."""

import functools

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from foredrive.search.find import vectors_of
from foredrive.search.index import FrameIndex
from foredrive.search.towers import PROMPTS, Towers, embed_prompt

UNRELATED = (
    *(
        "a wedding",
        "a birthday cake",
        "a bedroom",
        "a computer screen",
        "a plate of pasta",
        "a violin concert",
    ),
    *("a cat on a sofa", "a football match", "a spaceship", "a submarine", "a flower", "a volcano"),
    *("a swimming pool", "a giraffe"),
)
"""Texts about what no log of driving shows."""
QUANTILE = 0.9
"""A text has to be shown better than this share of the unrelated ones."""
VARIANCE = 0.999
"""Share of the embeddings' variance in the directions that count as shown."""
LEAST_ROWS, SAMPLED_ROWS = 100, 4000
"""Number of rows below which nothing is said, and at most as many are read."""


def resembles(index: FrameIndex, text: Float[ndarray, "D"], towers: Towers) -> bool | None:
    """Return whether an index shows more of a text than of unrelated texts.

    Images of other logs than those of the training have embeddings too, and one of them is always the nearest
    to a text. How near it is says little: the best hits of "an elephant" lie as far above the index's median
    as those of "a truck". But a text about something that the towers have not learnt to see points out of the
    space in which the embeddings of images differ.

    Args:
        text: unit vector of the text.

    Returns:
        None if the index has too few images to tell.
    """
    shown = _shown_directions(index.uri, index.count())
    if shown is None:
        return None
    unrelated = shown_share(shown, _unrelated(towers))  # type: ignore[arg-type]  # hashed by identity
    return bool(shown_share(shown, text[None])[0] > np.quantile(unrelated, QUANTILE))


def principal_directions(vectors: Float[ndarray, "n D"], variance: float) -> Float[ndarray, "K D"]:
    """Return the fewest orthonormal directions that hold a share of the variance."""
    _, spread, directions = np.linalg.svd(vectors - vectors.mean(0), full_matrices=False)
    share = np.cumsum(spread**2) / np.sum(spread**2)
    return np.asarray(directions[: int(np.searchsorted(share, variance)) + 1])


def shown_share(directions: Float[ndarray, "K D"], units: Float[ndarray, "m D"]) -> Float[ndarray, "m"]:
    """Return the share of unit vectors' squared length in the span of orthonormal directions, 0 to 1."""
    return np.asarray(((units @ directions.T) ** 2).sum(-1))


@functools.lru_cache(maxsize=2)
def _shown_directions(uri: str, rows: int) -> Float[ndarray, "K D"] | None:
    """Return the directions in which images of an index with so many rows differ."""
    vectors = vectors_of(FrameIndex(uri).sample(["image"], min(rows, SAMPLED_ROWS)), "image")
    vectors = vectors[~np.isnan(vectors).any(-1)]
    return principal_directions(vectors, VARIANCE) if len(vectors) >= LEAST_ROWS else None


@functools.lru_cache(maxsize=1)
def _unrelated(towers: Towers) -> Float[ndarray, "m D"]:
    return np.stack([embed_prompt(towers, text, PROMPTS).numpy() for text in UNRELATED])
