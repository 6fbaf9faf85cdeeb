"""Polylines: the distance along them, and points at a distance."""

import numpy as np
from jaxtyping import Float, Float64


def arc_lengths(points: Float[np.ndarray, "N D"]) -> Float64[np.ndarray, "N"]:
    """Return the distance along a polyline in the plane or in space, from its start to each point."""
    steps = np.diff(points, axis=0)
    step_m = np.hypot(*steps.T) if steps.shape[1] == 2 else np.linalg.norm(steps, axis=1)
    return np.append(0.0, np.cumsum(step_m))


def points_at(
    points: Float[np.ndarray, "N D"], arc_m: Float64[np.ndarray, "N"], at_m: float | Float[np.ndarray, "n"]
) -> Float64[np.ndarray, "*n D"]:
    """Return the points of a polyline at some distances along it. Beyond its ends, they are its ends.

    Args:
        arc_m: distance along the polyline of each of its points.
    """
    return np.stack([np.interp(at_m, arc_m, axis) for axis in points.T], axis=-1)
