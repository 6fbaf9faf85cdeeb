"""Pixels of actors, and errors in them, by hand."""

import math

import torch

from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.methods.reconstruction.evaluation import actor_pixels
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.views import CameraView
from foredrive.scene import Category


def front_view(t_s: float) -> CameraView:
    """An image of 60 by 100 px at the origin, which looks along x."""
    return CameraView(
        K=torch.tensor([[100.0, 0, 50], [0, 100, 30], [0, 0, 1]]),
        dist=torch.zeros(5),
        T_scene_cam=torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
        twist_cam=torch.zeros(6),
        t_s=t_s,
        readout_s=0.0,
        size_hw=(60, 100),
        sensor=0,
    )


def actors() -> ActorTracks:
    """A person who walks to the right, and turned by 90°; a car around the camera; one that comes later."""
    yaw = torch.tensor([math.pi / 2, 0.0, 0.0])
    start = torch.tensor([[11.0, 1, 0], [0.0, 0, 0], [20.0, 0, 0]])
    way = torch.tensor([[0.0, -2, 0], [0.0, 0, 0], [0.0, 0, 0]])
    places = torch.stack([start, start + way], dim=1)
    present = torch.tensor([[True, True], [True, True], [False, True]])
    sizes = torch.tensor([[1.0, 2, 2], [4.0, 2, 2], [4.0, 2, 2]])
    category = torch.tensor([Category.PEDESTRIAN, Category.CAR, Category.CAR])
    poses = matrix_from_yaw(yaw[:, None].expand(3, 2), places)
    return ActorTracks(torch.tensor([1, 2, 3]), category, sizes, torch.tensor([0.0, 2.0]), poses, present)


def test_a_box_fills_the_rectangle_of_its_nearest_face_at_the_time_of_exposure() -> None:
    """Its depth is its width when it is turned: the near face is at 10 m, 1 m wide and 2 m high."""
    at_start, halfway = (actor_pixels(actors(), front_view(t_s)) for t_s in (0.0, 1.0))
    expected = torch.zeros(60, 100, dtype=torch.bool)
    # ±1 m at 10 m are ±10 px; ±0.5 m are ±5 px
    expected[20:40, 45:55] = True
    assert torch.equal(halfway, expected)
    # At the start its middle is 1 m to the left: 0.5 m to 1.5 m at 10 m, and 0.5 m at 12 m (4.2 px)
    expected = torch.zeros(60, 100, dtype=torch.bool)
    expected[20:40, 35:46] = True
    assert torch.equal(at_start, expected)


def test_without_actors_no_pixel_counts() -> None:
    assert not bool(actor_pixels(actors().only(torch.tensor([1, 2])), front_view(0.0)).any())
