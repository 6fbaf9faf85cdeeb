"""Probability-based detection quality of image boxes (Hall et al., WACV 2020)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.optimize import linear_sum_assignment
from scipy.special import ndtr

MIN_PROBABILITY = 1e-14
"""Probabilities of pixels are kept this far from 0 and 1, as in the authors' code."""
OUTSIDE_STD = 6.0
"""A box reaches no farther than this many standard deviations beyond its edges."""


class PdqCounts(NamedTuple):
    """Counts of one frame; those of several add up."""

    quality: float
    """Sum over pairs of a positive quality."""
    pairs: int
    false: int
    missed: int


def pixel_quality(
    mean: Float[ndarray, "M 4"],
    std: Float[ndarray, "M 4"],
    class_probability: Float[ndarray, "M K"],
    boxes: Float[ndarray, "N 4"],
    label: Int[ndarray, "N"],
) -> Float[ndarray, "M N"]:
    """Return √(spatial quality · label quality) of each pair, in [0, 1]; corners in px, objects filled boxes.

    A pixel is in a detection with the probability that its middle lies right of x1, left of x2, below y1 and
    above y2; edges are independent and normal. Pairs of boxes that do not meet have quality 0.
    """
    quality = np.zeros((len(mean), len(boxes)))
    # Most pairs of boxes do not meet, and need no image
    meets = ((mean[:, None, :2] < boxes[:, 2:]) & (boxes[:, :2] < mean[:, None, 2:])).all(-1)
    for i, j in np.argwhere(meets):
        spatial = _spatial_quality(mean[i], std[i], boxes[j])
        quality[i, j] = np.sqrt(spatial * class_probability[i, label[j]])
    return quality


def count_pdq(quality: Float[ndarray, "M N"]) -> PdqCounts:
    """Count the pairs of the assignment of the largest total quality."""
    # Assignment of the largest total quality; pairs without quality are no pairs
    i, j = linear_sum_assignment(-quality)
    paired = quality[i, j][quality[i, j] > 0]
    pairs = len(paired)
    return PdqCounts(float(paired.sum()), pairs, quality.shape[0] - pairs, quality.shape[1] - pairs)


def pdq(counts: list[PdqCounts]) -> float:
    """Return the mean quality over pairs, false detections and missed objects of all frames; NaN if none."""
    total = np.sum(np.array([*counts, (0.0, 0, 0, 0)]), axis=0)
    return float(total[0] / total[1:].sum()) if total[1:].sum() else float("nan")


def _spatial_quality(mean: Float[ndarray, "4"], std: Float[ndarray, "4"], box: Float[ndarray, "4"]) -> float:
    """Return exp(-(loss of foreground + loss of background)), each a mean over the object's pixels."""
    along, inside_x = _along(mean[[0, 2]], std[[0, 2]], box[[0, 2]])
    down, inside_y = _along(mean[[1, 3]], std[[1, 3]], box[[1, 3]])
    # Pixels of the object, and probability of each pixel to be in the detection: a product over both axes
    inside = inside_y[:, None] & inside_x
    pixels = inside.sum()
    if pixels == 0:
        return 0.0
    covered = np.clip(down[:, None] * along, MIN_PROBABILITY, 1 - MIN_PROBABILITY)
    # Log-likelihood of the object's pixels as foreground and of the others as background
    loss = np.log(covered[inside]).sum() + np.log1p(-covered[~inside]).sum()
    return float(np.exp(loss / pixels))


def _along(
    edges: Float[ndarray, "2"], std: Float[ndarray, "2"], box: Float[ndarray, "2"]
) -> tuple[Float[ndarray, "n"], ndarray]:
    """Return which pixels of a row lie between the edges, as a probability, and which are the object's."""
    # Pixels that either the object or the uncertain detection can reach
    low = np.floor(min(edges[0] - OUTSIDE_STD * std[0], box[0]))
    high = np.ceil(max(edges[1] + OUTSIDE_STD * std[1], box[1]))
    middle = np.arange(low, high) + 0.5
    # The middle lies right of the first edge and left of the second
    probability = ndtr((middle - edges[0]) / std[0]) * ndtr((edges[1] - middle) / std[1])
    return probability, (middle >= box[0]) & (middle <= box[1])
