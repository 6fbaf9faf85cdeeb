"""Targets that teach a driver's features where road users are, in images and beside the route."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.driver.route_cells import route_cells
from foredrive.geometry.boxes import box_corners
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import Boxes, Clip
from foredrive.scene.boxes import VEHICLES, Category, Visibility

VULNERABLE = frozenset({Category.PEDESTRIAN, Category.BICYCLE, Category.MOTORCYCLE})
USERS = (VEHICLES - VULNERABLE, VULNERABLE)
"""Kinds of road users."""
MIN_CORNER_M = 0.5
"""A road user is in an image if all corners of its box are at least this deep, m."""
NEAR_M, BETWEEN_M = 1.2, 2.0
"""A road user is in the cells whose middles are nearer to its footprint than the first, m, and in the nearest
of all within the second: the outer cells are far apart."""


@dataclass(frozen=True)
class RoadUserCells:
    """Road users in the cells of `route_cells`."""

    present: Bool[Tensor, "b K G L"]
    """By kind, as in `USERS`."""
    known: Bool[Tensor, "b K G L"]
    """False where only road users are that are mostly hidden."""
    velocity: Float[Tensor, "b 2 G L"]
    """Velocity along the route and to its left of the road user nearest to the middle, m/s."""
    velocity_known: Bool[Tensor, "b G L"]


def road_user_pixels(
    clip: Clip, size: tuple[int, int]
) -> tuple[Bool[Tensor, "b C K h w"], Bool[Tensor, "b C K h w"]]:
    """Return where road users are in feature maps of the images at now, and where that is known.

    A road user fills the rectangle around the corners of its box. Where only those are that are mostly
    hidden, it is not known.

    Args:
        clip: its cameras and boxes are read.
        size: rows h and columns w of the maps.
    """
    boxes, rig = clip.boxes[:, clip.now], clip.rig[:, clip.now]
    b, cameras = rig.K.shape[:2]
    # Corners of all boxes in all cameras, in pixels of the feature map
    corners = box_corners(boxes.centre, boxes.size_lwh, boxes.yaw).flatten(1, 2)
    in_camera = transform_points(inverse_se3(rig.T_ego_cam), corners[:, None].expand(b, cameras, -1, -1))
    uv, depth_m, _ = project(in_camera, rig.K, rig.dist, rig.size_hw)
    uv, depth_m = uv.unflatten(2, (-1, 8)), depth_m.unflatten(2, (-1, 8))
    scale = uv.new_tensor([size[1] / rig.size_hw[1], size[0] / rig.size_hw[0]])
    # Bounding rectangles in whole cells
    first, last = (uv.amin(-2) * scale).floor(), (uv.amax(-2) * scale).ceil()  # [b C M 2]
    x, y = (torch.arange(count, device=uv.device) for count in size[::-1])
    columns = (x >= first[..., :1]) & (x < last[..., :1])
    rows = (y >= first[..., 1:]) & (y < last[..., 1:]) & (depth_m > MIN_CORNER_M).all(-1, keepdim=True)

    # A cell is filled if any box of the kind covers its row and its column
    def filled(kinds: Bool[Tensor, "b K M"]) -> Bool[Tensor, "b C K h w"]:
        return torch.einsum("bcmh,bkm,bcmw->bckhw", rows.float(), kinds.float(), columns.float()) > 0

    seen, hidden = _kinds(boxes)
    present = filled(seen)
    return present, present | ~filled(hidden)


def road_user_cells(clip: Clip) -> RoadUserCells:
    """Return which cells along and beside the route road users are in at now, and how they move.

    Args:
        clip: its route and boxes are read.
    """
    boxes = clip.boxes[:, clip.now]
    cells = route_cells(clip.route_xy, clip.route_valid)
    middles, shape = cells.flatten(1, 2), cells.shape[1:3]
    if boxes.valid.shape[1] == 0:
        none = torch.zeros(len(cells), len(USERS), *shape, dtype=torch.bool, device=cells.device)
        return RoadUserCells(none, ~none, torch.zeros_like(cells).movedim(-1, 1), none[:, 0])
    # Distance of each middle from each footprint, in the axes of the box.
    offset = middles[:, :, None] - boxes.centre[:, None, :, :2]  # [b N M 2]
    cos, sin = boxes.yaw.cos()[:, None], boxes.yaw.sin()[:, None]
    ahead = cos * offset[..., 0] + sin * offset[..., 1]
    left = cos * offset[..., 1] - sin * offset[..., 0]
    outside = torch.stack([ahead, left], dim=-1).abs() - 0.5 * boxes.size_lwh[:, None, :, :2]
    distance_m = outside.clamp_min(0).norm(dim=-1)
    nearest = distance_m <= distance_m.amin(1, keepdim=True)
    inside = (distance_m < NEAR_M) | (nearest & (distance_m < BETWEEN_M))

    def filled(kinds: Bool[Tensor, "b K M"]) -> Bool[Tensor, "b K G L"]:
        return (torch.einsum("bnm,bkm->bkn", inside.float(), kinds.float()) > 0).unflatten(2, shape)

    seen, hidden = _kinds(boxes)
    present = filled(seen)
    # Velocity of the nearest that is seen, in the axes of the route. Across is from its right to its left.
    mine = inside & seen.any(1)[:, None]
    row = distance_m.masked_fill(~mine, torch.inf).argmin(-1)
    velocity = boxes.velocity.gather(1, row[..., None].expand(-1, -1, 2)).unflatten(1, shape)
    across = cells[:, :, -1] - cells[:, :, 0]
    across = (across / across.norm(dim=-1, keepdim=True))[:, :, None]
    forward = velocity[..., 0] * across[..., 1] - velocity[..., 1] * across[..., 0]
    moved = torch.stack([forward, (velocity * across).sum(-1)], dim=1)
    measured = mine.any(-1).unflatten(1, shape) & velocity.isfinite().all(-1)
    return RoadUserCells(present, present | ~filled(hidden), moved.nan_to_num(), measured)


def _kinds(boxes: Boxes) -> tuple[Bool[Tensor, "b K M"], Bool[Tensor, "b K M"]]:
    """Return by kind which boxes are seen and which are mostly hidden, as far as the log tells."""
    kinds = [torch.tensor(sorted(kind), device=boxes.category.device) for kind in USERS]
    valid = torch.stack([boxes.valid & torch.isin(boxes.category, kind) for kind in kinds], dim=1)
    hidden = (boxes.visibility == Visibility.V0_40)[:, None]
    return valid & ~hidden, valid & hidden
