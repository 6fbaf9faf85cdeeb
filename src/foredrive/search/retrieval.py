"""Ranks of retrieval, and intervals of figures over sequences."""

import numpy as np
from jaxtyping import Float, Int

ROWS_AT_ONCE = 1024
_TIE = 1e-6
"""Difference of cosines up to which two items are equally similar; it is above the error of a product."""


def match_rank(queries: Float[np.ndarray, "n D"], gallery: Float[np.ndarray, "n D"]) -> Int[np.ndarray, "n"]:
    """Return for each query the rank, from 1, of its own item: item i of the gallery belongs to query i.

    Both are unit vectors. Other items that are as similar as the query's own item rank before it.
    """
    own = (queries * gallery).sum(axis=1)
    shares = [
        (queries[start : start + ROWS_AT_ONCE] @ gallery.T >= own[start : start + ROWS_AT_ONCE, None] - _TIE)
        for start in range(0, len(queries), ROWS_AT_ONCE)
    ]
    return np.concatenate([rows.sum(axis=1) for rows in shares])


def mean_of_groups(
    values: Float[np.ndarray, "n"],
    group: Int[np.ndarray, "n"],
    sequence: Int[np.ndarray, "n"],
    drawn: Int[np.ndarray, "B S"],
) -> Float[np.ndarray, "B"]:
    """Return, for each draw of sequences, the mean over groups of the mean of each group.

    A group without a value in a draw is left out of it.
    """
    shape = (drawn.max() + 1, group.max() + 1)
    # Sums per sequence and group, so that a draw only adds the rows of its sequences
    total, count = np.zeros(shape), np.zeros(shape)
    np.add.at(total, (sequence, group), values)
    np.add.at(count, (sequence, group), 1)
    sums, counts = total[drawn].sum(axis=1), count[drawn].sum(axis=1)
    filled = counts > 0
    means = np.where(filled, sums / counts.clip(min=1), 0).sum(axis=1)
    return np.where(filled.any(axis=1), means / filled.sum(axis=1).clip(min=1), np.nan)


def draw_sequences(sequences: int, draws: int, seed: int) -> Int[np.ndarray, "B S"]:
    """Return each sequence once, then draws with replacement (Efron & Tibshirani 1993, chapter 6)."""
    drawn = np.random.default_rng(seed).integers(sequences, size=(draws, sequences))
    return np.concatenate([np.arange(sequences)[None], drawn])


def mean_and_interval(values: Float[np.ndarray, "B"]) -> tuple[float, float, float]:
    """Return the value of all sequences, and its 2.5 and 97.5 % quantiles over `draw_sequences`."""
    low, high = np.nanquantile(values[1:], (0.025, 0.975))
    return float(values[0]), float(low), float(high)
