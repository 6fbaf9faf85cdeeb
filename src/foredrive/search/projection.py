"""Projection of the indexed scenes to a plane, where similar scenes are close together."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from foredrive.search.find import vectors_of
from foredrive.search.index import FrameIndex
from foredrive.search.rows import FACTS, WHOLE, IndexRow
from foredrive.search.tables import quoted, quoted_list

MOST_POINTS = 5000


class Plane(NamedTuple):
    """Whole scenes with their positions on the plane."""

    xy: Float[ndarray, "n 2"]
    """The first two principal components, scaled to -1 … 1."""
    rows: list[IndexRow]
    share: float
    """Share of the variance that the plane shows."""
    total: int
    """Number of all whole scenes. Above `MOST_POINTS`, an even subsample is shown."""


def project_scenes(index: FrameIndex) -> Plane:
    """Compute the principal components of the image embeddings of whole scenes."""
    where = f"view = {quoted(WHOLE)} AND image IS NOT NULL"
    total = index.count(where)
    if total > MOST_POINTS:
        # Sorted, so that the choice depends neither on the order of rows nor on the spacing of frames
        keys = sorted(index.select(where, ["key"])["key"].to_pylist())
        where += f" AND key IN ({quoted_list(keys[:: -(-total // MOST_POINTS)])})"
    rows = index.select(where, [*FACTS.names, "image"])
    vectors = vectors_of(rows, "image")
    if len(vectors) < 2:
        return Plane(np.zeros((len(vectors), 2)), IndexRow.all_of(rows), 0.0, total)
    centred = vectors - vectors.mean(0)
    variance, axes = np.linalg.eigh(centred.T @ centred)
    # Eigenvalues are in ascending order, so the last two axes come first
    xy = centred @ axes[:, :-3:-1]
    xy /= np.abs(xy).max(0).clip(min=1e-9)
    share = float(variance[-2:].sum() / max(float(variance.sum()), 1e-12))
    return Plane(xy, IndexRow.all_of(rows), share, total)
