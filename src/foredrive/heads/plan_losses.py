"""Imitation of the driven path, and the error of a predicted ego motion."""

from itertools import product

from jaxtyping import Bool, Float, Float64
from torch import Tensor

from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.ops.masked import masked_mean
from foredrive.scene import Trajectory, VoxelSpec


def waypoint_loss(plan: Trajectory, driven: Trajectory) -> Float[Tensor, ""]:
    """Return the mean distance ‖ŷ − y‖₂ over the valid steps, m (NeMo eq. 14); 0 when none is valid."""
    squared = ((plan.xy - driven.xy) ** 2).sum(-1)
    distance = (squared + 1e-12).sqrt()  # the gradient of a bare root is infinite at 0
    return masked_mean(distance, driven.valid)


def l1_waypoint_loss(
    planned: Float[Tensor, "b T D"], driven: Float[Tensor, "b T D"], valid: Bool[Tensor, "b T"]
) -> Float[Tensor, ""]:
    """Return the L1 distance over D coordinates, averaged over the valid steps; 0 when none is valid."""
    return masked_mean((planned - driven).abs().sum(dim=-1), valid)


def ego_motion_loss(
    T_now_ego: Float[Tensor, "b 4 4"],
    T_world_now: Float64[Tensor, "b 4 4"],
    T_world_ego: Float64[Tensor, "b 4 4"],
    spec: VoxelSpec,
) -> Float[Tensor, ""]:
    """Return the mean distance by which a predicted ego motion displaces the corners of a grid, m.

    Rotations count by what they move at the border of the volume that they warp.

    Args:
        T_now_ego: predicted motion to a later ego frame.
        T_world_now, T_world_ego: measured poses now and then.
        spec: grid.
    """
    # Corners of the volume
    corners_m = T_now_ego.new_tensor(list(product(*zip(spec.lower_m, spec.upper_m, strict=True))))
    # Driven motion from now to the later frame
    driven = (inverse_se3(T_world_now) @ T_world_ego).to(T_now_ego)
    corners_m = corners_m.expand(len(driven), -1, -1)
    error_m = transform_points(T_now_ego, corners_m) - transform_points(driven, corners_m)
    return ((error_m**2).sum(-1) + 1e-12).sqrt().mean()
