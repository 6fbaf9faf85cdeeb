"""Rows of a table by the frame that they belong to."""

import numpy as np
from jaxtyping import Int
from numpy import ndarray


def rows_by_frame(frame: Int[ndarray, "n"]) -> dict[int, Int[ndarray, "_"]]:
    """Return the indices of each frame's rows, in their order, by the frame's number."""
    order = np.argsort(frame, kind="stable")
    names, start = np.unique(frame[order], return_index=True)
    return dict(zip(names.tolist(), np.split(order, start[1:]), strict=True)) if len(names) else {}
