"""Cells along and beside the route, where a driver looks, and the image features there."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.driving.speed_rule import FRONT_M
from foredrive.geometry.precision import full_precision
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import CameraRig
from foredrive.scene.affordances import CELL_M, CELLS
from foredrive.scene.clip import ROUTE_M

BESIDE_M = (-12.0, -8.5, -6.0, -4.0, -2.2, -0.8, 0.8, 2.2, 4.0, 6.0, 8.5, 12.0)
"""Distances of the cells from the route, m, positive to the left: those who cross come from up to 15 m."""
HEIGHTS_M = (0.4, 1.3)
"""Heights above the road at which images are read: wheels and legs, bodies."""

LINE_CELLS, LINE_CELL_M = 48, 1.0
LINE_BESIDE_M = (-2.4, -0.8, 0.8, 2.4)
"""Cells of the ground in which the stop line of the next light is looked for: a line is 0.4 m wide."""
LINE_FROM_M = 2.0
"""Distance from the front bumper within which a line is below the image of `front_tele`'s wide camera."""


def route_cells(
    route_xy: Float[Tensor, "b R 2"],
    route_valid: Bool[Tensor, "b R"],
    count: int = CELLS,
    size_m: float = CELL_M,
    beside_m: Sequence[float] = BESIDE_M,
) -> Float[Tensor, "b G L 2"]:
    """Return the middles of the cells along a route from the front bumper on, ego frame, m.

    The route is straight between its points, and begins at the rear axle. Beyond its last valid point it goes
    straight on.

    Args:
        route_xy: points of the route at the distances `ROUTE_M`, ego frame, m.
        route_valid: which of them exist.
        count: number of cells along the route.
        size_m: length of a cell.
        beside_m: distances of the cells from the route, positive to the left.
    """
    given_m = route_xy.new_tensor((0.0, *ROUTE_M))
    # The route's points with the rear axle as the first one
    points = torch.cat([torch.zeros_like(route_xy[:, :1]), route_xy], dim=1)
    direction = _unit(points[:, 1:] - points[:, :-1])
    # Points beyond the end lie on the straight line through the last two valid ones.
    along = [points[:, 0]]
    ahead = torch.tensor([1.0, 0.0]).to(points).expand(len(points), 2)
    for k in range(1, len(given_m)):
        valid = route_valid[:, k - 1 : k]
        moved = (points[:, k] - along[-1]).norm(dim=-1, keepdim=True) > 1e-3
        # The last valid direction that is longer than a rounding error
        ahead = torch.where(valid & moved, direction[:, k - 1], ahead)
        along.append(torch.where(valid, points[:, k], along[-1] + (given_m[k] - given_m[k - 1]) * ahead))
    line = torch.stack(along, dim=1)
    # Middles lie on the straight piece between the two points around them.
    middle_m = FRONT_M + size_m * (torch.arange(count, device=line.device) + 0.5)
    # Distances are the nominal ones, so the piece of each middle is the same in the whole batch
    before = (torch.searchsorted(given_m, middle_m) - 1).clamp(0, len(given_m) - 2)
    share = (middle_m - given_m[before]) / (given_m[before + 1] - given_m[before])
    step = line[:, before + 1] - line[:, before]
    middle = line[:, before] + share[:, None] * step
    # To the left of the way: (-y, x).
    left = _unit(step)[..., [1, 0]] * step.new_tensor([-1.0, 1.0])
    beside = step.new_tensor(beside_m)
    return middle[:, :, None] + beside[:, None] * left[:, :, None]


def line_cells(
    route_xy: Float[Tensor, "b R 2"], route_valid: Bool[Tensor, "b R"]
) -> Float[Tensor, "b N S 2"]:
    """Return the middles of the cells in which the stop line is looked for, as `route_cells`."""
    return route_cells(route_xy, route_valid, LINE_CELLS, LINE_CELL_M, LINE_BESIDE_M)


def _unit(step: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
    return step / step.norm(dim=-1, keepdim=True).clamp_min(1e-6)


def sample_cameras(
    features: Float[Tensor, "b C F h w"],
    image_valid: Bool[Tensor, "b C"],
    rig: CameraRig,
    points: Float[Tensor, "b N 3"],
) -> Float[Tensor, "b C F+1 N"]:
    """Return the features of each camera at points in the ego frame, and as the last channel if it sees them.

    Args:
        features: feature maps of C images that cover the whole images.
        image_valid: features of missing images are not read.
        rig: the cameras, [b C].
        points: m.
    """
    b, cameras, channels = features.shape[:3]
    in_camera = transform_points(inverse_se3(rig.T_ego_cam), points[:, None].expand(-1, cameras, -1, -1))
    uv, _, inside = project(in_camera, rig.K, rig.dist, rig.size_hw)
    # A point counts if it is in the image and the image exists
    inside = (inside & image_valid[..., None]).flatten(0, 1)
    size_wh = uv.new_tensor([rig.size_hw[1], rig.size_hw[0]])
    with full_precision(features.flatten(0, 1), uv) as (maps, uv):
        # Pixels to grid_sample's range; what lies outside is masked by `seen`
        place = (2 * uv / size_wh - 1).clamp(-2, 2).flatten(0, 1)[:, :, None]
        read = F.grid_sample(maps, place, align_corners=False, padding_mode="border")[..., 0]
    seen = inside[:, None].to(read)
    return torch.cat([read * seen, seen], dim=1).view(b, cameras, channels + 1, -1)
