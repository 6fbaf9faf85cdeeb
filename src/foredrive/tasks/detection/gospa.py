"""GOSPA and probabilistic GOSPA between detections and objects, with their parts.

Sources: Rahmathullah, García-Fernández and Svensson (2017), α = 2; Xia et al. (arXiv 2412.11482), here with
objects that exist for certain.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.sets.assignment import best_assignment
from foredrive.sets.boxes import BoxDensity, LabelledBoxes


@dataclass(frozen=True)
class Gospa:
    """A distance and its parts: distance^p = localisation + existence + missed + false."""

    distance: float
    """In the unit of the base distance, such as m."""
    localisation: float
    existence: float
    """For existence other than 1 of detections that have an object."""
    missed: float
    false: float
    detection: Int[ndarray, "N"]
    """Detection of each object; -1: none."""


def gospa(
    distance: Float[ndarray, "M N"],
    cutoff: float,
    *,
    p: float = 2.0,
    existence: Float[ndarray, "M"] | None = None,
) -> Gospa:
    """Return GOSPA, or P-GOSPA where `existence` is given; everything of power p.

    A pair costs r·d^p + (1 - r)·c^p/2, a detection without an object r·c^p/2, a missed object c^p/2.
    `distance` is that between a detection (its density, for P-GOSPA) and an object; +inf where the two must
    not be paired. Pairs farther apart than `cutoff` never are.

    Raises `InputError` for distances that are negative or NaN, and for what is no probability.
    """
    if not (distance >= 0).all():
        raise InputError(f"distance {tuple(np.argwhere(~(distance >= 0))[0].tolist())} is not valid")
    r = np.ones(len(distance)) if existence is None else np.asarray(existence, dtype=np.float64)
    if not ((r >= 0) & (r <= 1)).all():
        raise InputError(f"existence ({np.flatnonzero(~((r >= 0) & (r <= 1)))[0]},) is not in [0, 1]")
    if not (cutoff > 0 and p >= 1):
        raise InputError("GOSPA needs a cutoff above 0 and a power of at least 1")
    # Half of c^p: the cost of a missed or of a false object
    half = 0.5 * cutoff**p
    near = distance < cutoff
    powers = np.where(near, np.minimum(distance, cutoff), 0.0) ** p
    # Cost of a pair relative to leaving the object missed; too distant pairs are impossible
    gain = np.where(near, r[:, None] * powers + (1.0 - r[:, None]) * half - half, np.inf)
    # A detection without an object costs r · c^p / 2
    column = best_assignment(gain, r * half).column
    # The four parts of the sum, from the best assignment
    paired = np.flatnonzero(column >= 0)
    detection = np.full(distance.shape[1], -1)
    detection[column[paired]] = paired
    localisation = float((r[paired] * powers[paired, column[paired]]).sum())
    mismatch = float(((1.0 - r[paired]) * half).sum())
    missed = half * int((detection < 0).sum())
    false = float(half * r[column < 0].sum())
    total = (localisation + mismatch + missed + false) ** (1.0 / p)
    return Gospa(total, localisation, mismatch, missed, false, detection)


def wasserstein_distance(boxes: BoxDensity, objects: LabelledBoxes, dims: int = 3) -> Float[ndarray, "M N"]:
    """Return the 2-Wasserstein distance between densities and the objects of a frame.

    √(|mean - y|² + tr Σ), the root of the expected squared distance, over the first `dims` coordinates.
    """
    with torch.no_grad():
        # Squared distance of the means, plus the trace of the covariance (the object has none)
        offset = boxes.mean[:, None, :dims].double() - objects.state[:, :dims].double()
        spread = boxes.chol[:, :dims].double().square().sum((-2, -1))
        return (offset.square().sum(-1) + spread[:, None]).sqrt().cpu().numpy()
