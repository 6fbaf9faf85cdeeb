"""Cells along a route, and image features there, by hand."""

import math
from collections.abc import Callable

import torch
from path_truth import SPEC

from foredrive.driver.route_cells import BESIDE_M, route_cells, sample_cameras
from foredrive.driving.speed_rule import FRONT_M
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import Example
from foredrive.scene.affordances import CELL_M, CELLS
from foredrive.scene.clip import ROUTE_M


def straight(heading_rad: float) -> torch.Tensor:
    return torch.tensor(ROUTE_M)[:, None] * torch.tensor([math.cos(heading_rad), math.sin(heading_rad)])


def test_cells_lie_along_and_beside_a_turned_route() -> None:
    """Two straight routes of different heading; the second ends after 15 m and goes on straight."""
    valid = torch.ones(2, len(ROUTE_M), dtype=torch.bool)
    valid[1, 4:] = False
    xy = torch.stack([straight(0.3), straight(-0.8)])
    xy[1, 4:] = xy[1, 3]  # its end
    cells = route_cells(xy, valid)
    along = FRONT_M + CELL_M * (torch.arange(CELLS) + 0.5)
    for row, heading in enumerate((0.3, -0.8)):
        ahead = torch.tensor([math.cos(heading), math.sin(heading)])
        left = torch.tensor([-math.sin(heading), math.cos(heading)])
        expected = along[:, None, None] * ahead + torch.tensor(BESIDE_M)[:, None] * left
        torch.testing.assert_close(cells[row], expected, atol=1e-3, rtol=0)


def test_cells_turn_with_the_route() -> None:
    """It goes 10 m straight on, then left: beyond the corner, left of the route is behind."""
    xy = torch.tensor([[2.0, 0], [5, 0], [10, 0], [10, 5], [10, 10], [10, 20], [10, 30]])[None]
    cells = route_cells(xy, torch.ones(1, 7, dtype=torch.bool))
    place = FRONT_M + CELL_M * 5.5  # 15.1 m along
    torch.testing.assert_close(
        cells[0, 5, 4:8], torch.tensor([[10 - b, place - 10] for b in BESIDE_M[4:8]]), atol=1e-3, rtol=0
    )


def test_features_are_read_where_a_camera_sees_a_point(make_example: Callable[..., Example]) -> None:
    """The features are the places in the image themselves, at half its resolution."""
    clip = make_example(spec=SPEC, batch=2).clip
    rig = clip.rig[:, clip.now]
    h, w = rig.size_hw[0] // 2, rig.size_hw[1] // 2
    y, x = torch.meshgrid(2 * torch.arange(h) + 1.0, 2 * torch.arange(w) + 1.0, indexing="ij")
    cameras = rig.K.shape[1]
    features = torch.stack([x, y]).expand(2, cameras, 2, h, w)
    points = torch.tensor([[6.0, 0.5, 1.2], [9.0, -2.0, 1.0], [-5.0, 1.0, 1.5], [3.0, 40.0, 1.0]]).expand(
        2, 4, 3
    )
    seen = torch.ones(2, cameras, dtype=torch.bool)
    seen[1, 0] = False
    read = sample_cameras(features, seen, rig, points)
    in_camera = transform_points(inverse_se3(rig.T_ego_cam), points[:, None].expand(-1, cameras, -1, -1))
    uv, _, inside = project(in_camera, rig.K, rig.dist, rig.size_hw)
    assert inside.any()
    assert not inside.all()
    inside = inside & seen[..., None]
    assert torch.equal(read[:, :, 2] > 0, inside)
    torch.testing.assert_close(read[:, :, :2].transpose(2, 3)[inside], uv[inside], atol=1e-3, rtol=0)
    assert not read[1, 0].any()
