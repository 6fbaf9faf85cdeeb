"""Cells of a path that footprints cover over time."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.geometry.path_frame import along_path

POINTS_LW = (9, 3)
"""Points of a footprint along and across it: neighbours are at most 0.6 m apart in a car, and the ends of a
long vehicle are joined by the cells between them."""
NEAR_M = 30.0
"""Footprints whose middle is further beside the path, m, are not placed; they would be 60 m long."""


def cells_covered(
    xy: Float[Tensor, "M T 2"],
    yaw: Float[Tensor, "M T"],
    valid: Bool[Tensor, "M T"],
    size_lw: Float[Tensor, "M 2"],
    path_xy: Float[Tensor, "R 2"],
    path_valid: Bool[Tensor, "R"],
    start_m: float,
    half_width_m: float,
    cells: int,
    cell_m: float,
) -> Bool[Tensor, "M T G"]:
    """Return which cells of a path each of M footprints covers at T times.

    Cell k of G = `cells` reaches from `start_m` + k `cell_m` to `start_m` + (k + 1) `cell_m` along the path.

    Args:
        xy, yaw: middle and heading of the footprints, m and rad, in the frame of the path.
        valid: whether there is a footprint.
        size_lw: length and width of the footprints, m.
        path_xy: polyline whose valid points come first, m.
        path_valid: which of its points exist.
        start_m: distance along the path at which the first cell begins.
        half_width_m: half the width of the cells.
    """
    # Footprints that are far beside the path cover nothing and are not sampled
    covered = torch.zeros(*yaw.shape, cells, dtype=torch.bool)
    _, beside_m = along_path(xy.flatten(0, 1), path_xy, path_valid)
    near = valid & (beside_m.view(valid.shape).abs() < NEAR_M)
    if not bool(near.any()):
        return covered
    # Points all over each footprint that may matter.
    share = torch.cartesian_prod(*(torch.linspace(-0.5, 0.5, count) for count in POINTS_LW))
    size = size_lw[:, None].expand(*yaw.shape, 2)[near]
    # Points in the box' axes, turned by the heading and moved to the middle
    local = share * size[:, None]
    cos, sin = yaw[near].cos()[:, None], yaw[near].sin()[:, None]
    turned = torch.stack(
        [cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]], dim=-1
    )
    points = xy[near][:, None] + turned
    placed = along_path(points.flatten(0, 1), path_xy, path_valid)
    along_m, left_m = (part.view(points.shape[:2]) for part in placed)
    # Points beyond an end of the path are placed at that end: only those beside it are on it.
    length_m = (path_xy.diff(dim=0).norm(dim=-1) * (path_valid[1:] & path_valid[:-1])).sum()
    inside = (left_m.abs() < half_width_m) & (along_m > 0) & (along_m < length_m)
    # Cells between the first and the last covered point are covered, also where no point fell
    cell = (along_m - start_m) / cell_m
    first = cell.masked_fill(~inside, torch.inf).amin(-1).floor()
    last = cell.masked_fill(~inside, -torch.inf).amax(-1).floor()
    index = torch.arange(cells)
    covered[near] = (index >= first[:, None]) & (index <= last[:, None])
    return covered
