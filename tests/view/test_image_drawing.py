"""Drawing into camera images: the right pixels change, and no others."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from foredrive.geometry.projection import pixels_to_rays
from foredrive.scene import Boxes, Category
from foredrive.scene.boxes import unlabelled
from foredrive.view.image_drawing import (
    Camera,
    draw_boxes_on_image,
    draw_path_on_image,
    draw_points_on_image,
    resize,
)
from foredrive.view.palette import BOX_COLOURS, rgb255

SIZE_HW = (60, 100)
CAR_RGB = rgb255(BOX_COLOURS[Category.CAR])


def camera_ahead(dist: tuple[float, ...] = (0, 0, 0, 0, 0)) -> Camera:
    """A camera at the ego origin that looks along x: u = 50 - 50 y/x, v = 30 - 50 z/x."""
    T_ego_cam = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    K = torch.tensor([[50.0, 0, 50], [0, 50, 30], [0, 0, 1]])
    return Camera(K, T_ego_cam, torch.tensor(dist, dtype=torch.float32), SIZE_HW)


def grey() -> np.ndarray:
    return np.full((*SIZE_HW, 3), 90, dtype=np.uint8)


def changed(image: np.ndarray) -> set[tuple[int, int]]:
    """(row, column) of pixels that are not grey any more."""
    return set(zip(*(i.tolist() for i in np.nonzero((image != 90).any(-1))), strict=True))


def one_box(x: float, y: float, z: float, lwh: tuple[float, float, float], yaw: float = 0.0) -> Boxes:
    return Boxes(
        torch.tensor([[float(x), y, z]]),
        torch.tensor([lwh], dtype=torch.float32),
        torch.tensor([float(yaw)]),
        torch.zeros(1, 2),
        torch.zeros(1, dtype=torch.long),
        torch.tensor([int(Category.CAR)]),
        torch.ones(1, dtype=torch.bool),
        **unlabelled(1),
    )


def test_a_point_lands_on_its_pixel() -> None:
    # u = 50 - 50 * 2 / 10 = 40, v = 30 - 50 * 1 / 10 = 25, moved to the middle of pixel (25, 40).
    point = torch.tensor([[10.0, 1.9, 0.9]])
    red = np.array([[255, 0, 0]], dtype=np.uint8)
    painted = draw_points_on_image(grey(), point, red, camera_ahead(), radius_px=0.6, alpha=1.0)
    assert changed(painted) == {(25, 40)}
    assert painted[25, 40].tolist() == [255, 0, 0]


def test_a_point_behind_the_camera_or_outside_the_image_draws_nothing() -> None:
    points = torch.tensor([[-10.0, 2.0, 1.0], [10.0, 11.0, 0.0], [10.0, 0.0, 7.0]])
    painted = draw_points_on_image(grey(), points, np.zeros((3, 3), np.uint8), camera_ahead())
    assert not changed(painted)


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_the_nearer_of_two_points_on_one_ray_is_seen(order: list[int]) -> None:
    points = torch.tensor([[5.0, 0.0, 0.0], [20.0, 0.0, 0.0]])[order]
    colours = np.array([[255, 0, 0], [0, 0, 255]], dtype=np.uint8)[order]
    painted = draw_points_on_image(grey(), points, colours, camera_ahead(), alpha=1.0)
    assert painted[30, 50].tolist() == [255, 0, 0]


def test_the_frame_of_a_box_runs_along_its_projected_edges() -> None:
    # Rear face at x = 10: y = ±2 -> u = 40, 60; z = ±1 -> v = 25, 35. Front face at x = 20 lies inside it.
    painted = draw_boxes_on_image(grey(), one_box(15, 0, 0, (10, 4, 2)), camera_ahead(), width_px=1.0)
    rows, columns = zip(*changed(painted), strict=True)
    assert min(columns) in (39, 40)
    assert max(columns) in (59, 60)
    assert min(rows) in (24, 25)
    assert max(rows) in (34, 35)
    assert {(25, 50), (35, 50)} <= {(r + d, c) for r, c in changed(painted) for d in (0, 1)}
    # The front face (u 45..55, v 27.5..32.5) is crossed through its middle; the rest of the inside is empty.
    assert (30, 50) in changed(painted)
    assert (33, 50) not in changed(painted)
    strongest = painted[tuple(np.argwhere((painted != 90).any(-1)).T)].astype(int)
    assert np.abs(strongest - CAR_RGB).sum(-1).min() == 0


@pytest.mark.parametrize("dist", [(0, 0, 0, 0, 0), (-0.2, 0.02, 0, 0, 0)])
def test_boxes_behind_the_camera_draw_nothing(dist: tuple[float, ...]) -> None:
    painted = draw_boxes_on_image(grey(), one_box(-15, 0, 0, (10, 4, 2)), camera_ahead(dist))
    assert not changed(painted)


def test_a_box_around_the_camera_is_cut_at_the_near_plane() -> None:
    # Of a box from x = -5 to 5 only the front face (u 25..75, v 15..45), its cross, and the four edges that
    # run from it towards the camera are in view; those leave the picture and never cross the middle.
    painted = draw_boxes_on_image(grey(), one_box(0, 0, 0, (10, 5, 3)), camera_ahead(), width_px=1.0)
    marks = changed(painted)
    assert (30, 50) in marks  # the cross
    outside = {(r, c) for r, c in marks if c < 23 or c > 77}
    assert outside
    for row, column in outside:  # on the lines from the image centre through the face's corners
        assert abs(abs(row + 0.5 - 30) - 0.6 * abs(column + 0.5 - 50)) < 1.5


def test_invalid_boxes_are_padding() -> None:
    box = one_box(15, 0, 0, (10, 4, 2))
    nothing = dataclasses.replace(box, valid=torch.zeros(1, dtype=torch.bool))
    assert not changed(draw_boxes_on_image(grey(), nothing, camera_ahead()))


@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(-6, 6),
    y=st.floats(-6, 6),
    yaw=st.floats(0, math.pi),
    k1=st.sampled_from([0.0, -0.05, 0.1]),
)
def test_every_painted_pixel_looks_at_the_box(x: float, y: float, yaw: float, k1: float) -> None:
    camera = camera_ahead((k1, 0, 0, 0, 0))
    painted = draw_boxes_on_image(grey(), one_box(x, y, 0, (4, 2, 1.5), yaw), camera, width_px=1.0)
    marks = sorted(changed(painted))
    if not marks:
        return
    uv = torch.tensor([[column + 0.5, row + 0.5] for row, column in marks])
    direction = pixels_to_rays(uv, camera.K, camera.dist) @ camera.T_ego_cam[:3, :3].T
    cos, sin = math.cos(yaw), math.sin(yaw)
    to_box = torch.tensor([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    origin, direction = to_box @ torch.tensor([-x, -y, 0.0]), direction @ to_box.T
    half = torch.tensor([2.0, 1.0, 0.75]) + 0.3  # 0.3 m are two pixels at the farthest box
    one, two = (-half - origin) / (direction + 1e-9), (half - origin) / (direction + 1e-9)
    enter, leave = torch.minimum(one, two).amax(-1), torch.maximum(one, two).amin(-1)
    assert bool(((enter <= leave) & (leave > 0)).all())


def test_a_path_is_painted_on_the_ground_ahead_only() -> None:
    path = torch.tensor([[-3.0, 0, -1], [10.0, 0, -1], [20.0, 0, -1]])
    painted = draw_path_on_image(grey(), path, camera_ahead(), "#ff0000")
    rows, columns = zip(*changed(painted), strict=True)
    assert min(rows) >= 31  # z = -1 at 20 m, its disc reaching to 20.3 m: v > 32.4; nothing above
    assert max(rows) == SIZE_HW[0] - 1
    assert 50 - min(columns) == max(columns) - 49  # symmetric about u = 50


def test_a_resized_camera_sees_the_same_directions() -> None:
    small = camera_ahead().resized((30, 50))
    point = torch.tensor([[10.0, 1.9, 0.9]])
    painted = draw_points_on_image(
        resize(grey(), (30, 50)), point, np.zeros((1, 3), np.uint8), small, radius_px=0.6
    )
    assert changed(painted) == {(12, 20)}
