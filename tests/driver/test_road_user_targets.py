"""Targets of road users in images and beside the route, by hand."""

import dataclasses
from collections.abc import Callable

import pytest
import torch
from path_truth import SPEC

from foredrive.driver.road_user_targets import road_user_cells, road_user_pixels
from foredrive.driver.route_cells import BESIDE_M
from foredrive.driving.speed_rule import FRONT_M
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import Boxes, Clip, Example
from foredrive.scene.boxes import UNKNOWN, Category, Visibility
from foredrive.scene.clip import ROUTE_M

CYCLIST_M = FRONT_M + 9.0
"""Distance of the cyclist along the route: the middle of the cell of index 4."""


def turned(xy: list[float]) -> list[float]:
    """The same place or velocity beside a route that leads to the left."""
    return [-xy[1], xy[0]]


def box(centre: list[float], velocity: list[float], kind: Category, shown: int, yaw: float) -> dict:
    return {"centre": centre, "velocity": velocity, "category": int(kind), "visibility": shown, "yaw": yaw}


@pytest.fixture
def clip(make_example: Callable[..., Example]) -> Clip:
    """Two items: a route straight ahead, and one to the left.

    A cyclist crosses each from its left at 3 m/s, a hidden man stands on the second cell, and a car whose
    velocity is unknown is beside the twentieth."""
    made = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    ahead = torch.tensor([[m, 0.0] for m in ROUTE_M])
    boxes, hidden = [], Visibility.V0_40
    for turn in (list, turned):
        yaw = 0.0 if turn is list else 0.5 * torch.pi
        boxes.append(
            [
                box([*turn([CYCLIST_M, 4.0]), 0.9], turn([0.0, -3.0]), Category.BICYCLE, UNKNOWN, yaw),
                box([*turn([FRONT_M + 3.0, 0.8]), 0.9], [0.0, 0.0], Category.PEDESTRIAN, hidden, yaw),
                box([*turn([FRONT_M + 39.0, -8.5]), 0.8], [torch.nan] * 2, Category.CAR, UNKNOWN, yaw),
                box([*turn([CYCLIST_M, -6.0]), 0.5], [0.0, 0.0], Category.BARRIER, UNKNOWN, yaw),
            ]
        )
    shape = made.boxes[:, made.now].valid.shape[0], 4

    def column(name: str, dtype: torch.dtype) -> torch.Tensor:
        values = torch.tensor([[one[name] for one in row] for row in boxes], dtype=dtype)
        return values[:, None].expand(-1, made.t_s.shape[1], *values.shape[1:]).clone()

    centre, size = column("centre", torch.float32), torch.tensor([0.6, 0.6, 1.8])
    whole = torch.ones(2, made.t_s.shape[1], shape[1], dtype=torch.bool)
    users = Boxes(
        centre=centre,
        size_lwh=size.expand_as(centre).clone(),
        yaw=column("yaw", torch.float32),
        velocity=column("velocity", torch.float32),
        track_id=whole.long(),
        category=column("category", torch.int64),
        valid=whole,
        num_points=whole.long(),
        attribute=whole.long(),
        visibility=column("visibility", torch.int64),
    )
    # Boxes of the frame before are not read.
    users.valid[:, 0] = False
    route = torch.stack([ahead, torch.stack([-ahead[:, 1], ahead[:, 0]], dim=-1)])
    return dataclasses.replace(
        made,
        route_xy=route,
        route_valid=torch.ones(2, len(ROUTE_M), dtype=torch.bool),
        boxes=users,
        boxes_valid=torch.ones_like(made.boxes_valid),
    )


def test_cells_beside_the_route_hold_who_is_there_and_how_it_moves(clip: Clip) -> None:
    cells = road_user_cells(clip)
    beside, car = BESIDE_M.index(4.0), BESIDE_M.index(-8.5)
    assert cells.present[:, 1].nonzero().tolist() == [[item, 4, beside] for item in (0, 1)]
    assert [item[1:] for item in cells.present[:, 0].nonzero().tolist()] == [[19, car], [19, car]]
    assert not cells.known[:, 1, 1, BESIDE_M.index(0.8)].any()
    assert cells.known.sum() == cells.known.numel() - (~cells.known[:, 1]).sum()
    for item in (0, 1):
        torch.testing.assert_close(cells.velocity[item, :, 4, beside], torch.tensor([0.0, -3.0]))
    assert cells.velocity_known[:, 4, beside].all()
    assert not cells.velocity_known[:, 19].any()
    nobody = dataclasses.replace(clip, boxes=clip.boxes[:, :, :0])
    assert not road_user_cells(nobody).present.any()
    assert road_user_cells(nobody).known.all()


def test_a_road_user_fills_the_rectangle_of_its_corners(clip: Clip) -> None:
    size = (24, 40)
    pixels, known = road_user_pixels(clip, size)
    rig = clip.rig[0, clip.now]
    centre = clip.boxes.centre[0, clip.now, 0]
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    corners = centre + signs * torch.tensor([0.3, 0.3, 0.9])
    in_camera = transform_points(inverse_se3(rig.T_ego_cam[0]), corners)
    uv = (in_camera / in_camera[:, 2:]) @ rig.K[0].T
    column = uv[:, 0] * size[1] / rig.size_hw[1]
    row = uv[:, 1] * size[0] / rig.size_hw[0]
    wanted = torch.zeros(size, dtype=torch.bool)
    left, right = int(column.min().floor()), int(column.max().ceil())
    wanted[max(int(row.min().floor()), 0) : int(row.max().ceil()), left:right] = True
    assert wanted.any()
    assert torch.equal(pixels[0, 0, 1], wanted)
    assert not pixels[1, 0, 1].any()  # to the left of the vehicle, out of the front camera
    hidden = ~known[0, 0, 1]
    assert hidden.any()
    assert not (hidden & wanted).any()
    assert known[:, :, 0].all()
