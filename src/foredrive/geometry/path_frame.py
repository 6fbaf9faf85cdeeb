"""Positions relative to a path: the distance along it and the distance to its left."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def along_path(
    points: Float[Tensor, "*b N 2"], path_xy: Float[Tensor, "*b R 2"], path_valid: Bool[Tensor, "*b R"]
) -> tuple[Float[Tensor, "*b N"], Float[Tensor, "*b N"]]:
    """Return the distance along a path to the place nearest to each point, and the distance from that place.

    The latter is positive to the left of the path. Beyond an end it is the distance from that end, so a point
    far beyond is far from the path. On a path of less than two valid points every point is infinitely far
    away.

    Args:
        points: to place, m.
        path_xy: polyline whose valid points come first, m.
        path_valid: which of its points exist.
    """
    start, step = path_xy[..., :-1, :], path_xy.diff(dim=-2)
    valid = path_valid[..., 1:] & path_valid[..., :-1]
    length = step.norm(dim=-1)
    # Arc length at the start of each segment; segments with an invalid end have no length
    begins = (length * valid).cumsum(-1) - length * valid
    offset = points[..., :, None, :] - start[..., None, :, :]  # [*b N R-1 2]
    # Foot of the perpendicular on every segment, clamped to it
    share = (offset * step[..., None, :, :]).sum(-1) / length.square().clamp_min(1e-12)[..., None, :]
    share = share.clamp(0, 1)
    away = offset - share[..., None] * step[..., None, :, :]
    # Segments that do not exist are infinitely far
    away_m = away.norm(dim=-1).masked_fill(~valid[..., None, :], torch.inf)
    nearest_m, segment = away_m.min(dim=-1)
    along = begins[..., None, :] + share * length[..., None, :]
    along_m = along.gather(-1, segment[..., None])[..., 0]
    # Cross product of segment and offset: positive to the left
    side = step[..., None, :, 0] * offset[..., 1] - step[..., None, :, 1] * offset[..., 0]
    left = side.gather(-1, segment[..., None])[..., 0] >= 0
    return along_m, torch.where(left, nearest_m, -nearest_m)


def path_headings(
    along_m: Float[Tensor, "*b N"], path_xy: Float[Tensor, "*b R 2"], path_valid: Bool[Tensor, "*b R"]
) -> Float[Tensor, "*b N 2"]:
    """Return the unit direction of a path at distances along it."""
    step = path_xy.diff(dim=-2)
    valid = path_valid[..., 1:] & path_valid[..., :-1]
    length = step.norm(dim=-1) * valid
    # The segment that contains the distance; beyond the end the last one
    ends = length.cumsum(-1)
    segment = (along_m[..., :, None] > ends[..., None, :]).sum(-1)
    segment = segment.clamp_max((valid.sum(-1, keepdim=True) - 1).clamp_min(0))
    unit = step / step.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    return unit.gather(-2, segment[..., None].expand(*segment.shape, 2))
