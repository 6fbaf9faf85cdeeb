"""Time until boxes touch, if all of them move at constant velocity."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

NEAR_COLLISION_S = 0.95
"""nuPlan's bound, s: a shorter time is not safe (Karnchanachari et al. 2024,
time_to_collision_within_bound)."""


class MovingBoxes(NamedTuple):
    """M boxes in the plane, all in one frame."""

    centre_m: Float64[np.ndarray, "M 2"]
    size_lw_m: Float64[np.ndarray, "M 2"]
    yaw_rad: Float64[np.ndarray, "M"]
    velocity_mps: Float64[np.ndarray, "M 2"]

    def only(self, which: Bool[np.ndarray, "M"]) -> "MovingBoxes":
        """Return the selected boxes."""
        return MovingBoxes(*(values[which] for values in self))


def time_to_collision_s(ego: MovingBoxes, others: MovingBoxes) -> Float64[np.ndarray, "M"]:
    """Return the time until the ego box first touches each of M other boxes, s.

    The time is 0 for boxes that touch now and infinite for boxes that never do. Boxes move without turning.
    Two boxes touch while their projections overlap on all four axes along their edges (separating axes). On
    each axis that is one interval of time, so the result is exact.

    Args:
        ego: one box.
    """
    offset, approach = others.centre_m - ego.centre_m, others.velocity_mps - ego.velocity_mps
    count = len(others.yaw_rad)
    begin, end = np.zeros(count), np.full(count, np.inf)
    # Axes along the edges of both boxes
    ego_axes, other_axes = _axes(np.repeat(ego.yaw_rad, count)), _axes(others.yaw_rad)
    for axis in (*ego_axes, *other_axes):
        # Half extent of both boxes along the axis
        reach = sum(
            0.5 * size * np.abs(np.einsum("mi,mi->m", edge, axis))
            for edges, sizes in ((ego_axes, ego.size_lw_m), (other_axes, others.size_lw_m))
            for edge, size in zip(edges, sizes.T, strict=True)
        )
        # Gap and closing speed along the axis, and the interval of time in which the projections overlap
        gap, speed = np.einsum("mi,mi->m", offset, axis), np.einsum("mi,mi->m", approach, axis)
        moves = np.abs(speed) > 1e-9
        per_speed = 1 / np.where(moves, speed, 1.0)
        enter, leave = np.sort([(-reach - gap) * per_speed, (reach - gap) * per_speed], axis=0)
        # Without relative motion, they overlap always or never
        apart = ~moves & (np.abs(gap) > reach)
        begin = np.maximum(begin, np.where(moves, enter, np.where(apart, np.inf, 0.0)))
        end = np.minimum(end, np.where(moves, leave, np.inf))
    # Touching begins when all axes overlap, if that happens before one of them ends
    return np.where((begin <= end) & np.isfinite(begin), begin, np.inf)


def _axes(yaw_rad: Float64[np.ndarray, "M"]) -> tuple[Float64[np.ndarray, "M 2"], Float64[np.ndarray, "M 2"]]:
    """Return unit vectors along the length and the width of boxes."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)
