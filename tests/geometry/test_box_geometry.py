"""Boxes."""

import math

import torch

from foredrive.geometry.boxes import box_corners, points_in_boxes


def test_corners_of_a_turned_box_by_hand() -> None:
    corners = box_corners(
        torch.tensor([10.0, 0.0, 1.0]), torch.tensor([4.0, 2.0, 2.0]), torch.tensor(math.pi / 2)
    )
    # Length runs along y now: the front-left bottom corner is at x - w/2, y + l/2, z - h/2.
    torch.testing.assert_close(corners[0], torch.tensor([9.0, 2.0, 0.0]))
    torch.testing.assert_close(corners[6], torch.tensor([11.0, -2.0, 2.0]))


def test_points_in_boxes() -> None:
    centre = torch.tensor([[10.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    size = torch.tensor([[4.0, 2.0, 2.0], [1.0, 1.0, 1.0]])
    yaw = torch.tensor([math.pi / 2, 0.0])
    points = torch.tensor([[10.0, 1.9, 1.0], [11.9, 0.0, 1.0], [0.4, -0.4, 0.4]])
    assert points_in_boxes(points, centre, size, yaw).tolist() == [
        [True, False],
        [False, False],
        [False, True],
    ]


def test_a_box_that_is_askew_holds_points_along_its_own_length() -> None:
    along = torch.tensor([math.cos(0.5), math.sin(0.5), 0.0])
    points = torch.stack([1.9 * along, 1.9 * along * torch.tensor([1.0, -1.0, 1.0])])
    inside = points_in_boxes(points, torch.zeros(1, 3), torch.tensor([[4.0, 1.0, 1.0]]), torch.tensor([0.5]))
    assert inside.tolist() == [[True], [False]]
