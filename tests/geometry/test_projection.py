"""Cameras."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from foredrive.geometry.projection import distort, pixel_centres, pixels_to_rays, project, undistort

K = torch.tensor([[100.0, 0.0, 80.0], [0.0, 100.0, 48.0], [0.0, 0.0, 1.0]])
IDEAL = torch.zeros(5)
SIZE = (96, 160)


def test_by_hand() -> None:
    points = torch.tensor([[0.0, 0.0, 5.0], [1.0, 0.0, 2.0], [0.0, 0.0, -5.0], [9.0, 0.0, 1.0]])
    uv, depth, inside = project(points, K, IDEAL, SIZE)
    torch.testing.assert_close(uv[:2], torch.tensor([[80.0, 48.0], [130.0, 48.0]]))
    torch.testing.assert_close(depth, torch.tensor([5.0, 2.0, -5.0, 1.0]))
    assert inside.tolist() == [True, True, False, False]


@given(st.floats(0, 159.9), st.floats(0, 95.9), st.floats(0.5, 60.0))
def test_rays_lead_back_to_their_pixels(u: float, v: float, depth_m: float) -> None:
    dist = torch.tensor([-0.1, 0.01, 1e-3, -1e-3, 0.0])
    ray = pixels_to_rays(torch.tensor([[u, v]]), K, dist)
    uv, _, _ = project(ray * depth_m, K, dist, SIZE)
    torch.testing.assert_close(uv, torch.tensor([[u, v]]), atol=1e-2, rtol=0)


def test_undistort_inverts_distort() -> None:
    dist = torch.tensor([-0.2, 0.05, 1e-3, 2e-3, 0.0])
    xy = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    torch.testing.assert_close(undistort(distort(xy, dist), dist), xy, atol=1e-4, rtol=0)


def test_points_far_outside_do_not_fold_back_into_the_image() -> None:
    strong = torch.tensor([-0.4, 0.0, 0.0, 0.0, 0.0])
    _, _, inside = project(torch.tensor([[1.5, 0.0, 1.0]]), K, strong, SIZE)
    assert not inside.item()


def test_pixel_centres_are_at_a_half() -> None:
    assert pixel_centres((2, 3))[1, 2].tolist() == [2.5, 1.5]
