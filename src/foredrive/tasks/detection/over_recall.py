"""True-positive errors averaged over recall, as nuScenes' devkit and UniAD report them."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

FIRST = 11
"""Recall 0.11, the first of 101 steps that counts: the devkit leaves out the step of its minimum, 0.1."""


def error_over_recall(
    score: Float[ndarray, "M"], hit: Bool[ndarray, "M"], objects: int, error: Float[ndarray, "H"]
) -> float:
    """Return the mean error of the hits over recall; 1 without a hit, or if recall stays below 0.11.

    At each step of recall it is the running mean over the hits, the best scored first, read at the score
    that this recall is reached with (nuscenes-devkit, eval/detection/algo.py, `accumulate` and `calc_tp`).

    Args:
        score, hit: of the predictions, in order of descending score.
        error: of the hits, in the same order. NaN where it is not known.
    """
    if not hit.any():
        return 1.0
    # Recall after each prediction
    recall = np.cumsum(hit) / objects
    # Score at which each of 101 recalls is reached; 0 beyond the largest one
    at_recall = np.interp(np.linspace(0, 1, 101), recall, score, right=0.0)
    # Running mean error as a function of the score; np.interp needs ascending scores, hence the reversals
    curve = np.interp(at_recall[::-1], score[hit][::-1], running_mean(error)[::-1])[::-1]
    # Steps from recall 0.11 to the largest recall that is reached
    reached = np.flatnonzero(at_recall)
    last = int(reached[-1]) if len(reached) else 0
    return float(curve[FIRST : last + 1].mean()) if last >= FIRST else 1.0


def running_mean(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Return the mean of the known values so far: 0 before the first, 1 everywhere if none is known."""
    # Unknown errors count neither in the sum nor in the number
    valid: Bool[ndarray, n] = ~np.isnan(values)
    if not valid.any():
        return np.ones(len(values))
    count = np.cumsum(valid)
    return np.divide(np.nancumsum(values), count, out=np.zeros(len(values)), where=count > 0)
