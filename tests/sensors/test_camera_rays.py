"""Pixels to timed rays."""

import dataclasses

import pytest
import torch

from foredrive.geometry.projection import pixel_centres, project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import CameraRig
from foredrive.sensors import camera_rays

SIZE = (6, 8)
LOOKING_LEFT = torch.tensor([[1.0, 0, 0, 1], [0, 0, 1, 2], [0, -1, 0, 3], [0, 0, 0, 1]])  # cam z along ego y


def make_rig(readout_s: float = 0.0) -> CameraRig:
    K = torch.tensor([[5.0, 0.0, 4.0], [0.0, 5.0, 3.0], [0.0, 0.0, 1.0]])
    return CameraRig(
        K=K[None],
        T_ego_cam=LOOKING_LEFT[None],
        dist=torch.zeros(1, 5),
        readout_s=torch.tensor([readout_s]),
        names=("cam",),
        size_hw=SIZE,
    )


def test_points_along_the_rays_project_to_their_pixels() -> None:
    rig = make_rig()
    rays = camera_rays(rig)
    points_cam = transform_points(inverse_se3(rig.T_ego_cam), rays.origin_ego + 7.0 * rays.dir_ego)
    uv, depth, _ = project(points_cam, rig.K, rig.dist, SIZE)
    torch.testing.assert_close(uv[0], pixel_centres(SIZE).reshape(-1, 2))
    assert (depth > 0).all()
    assert rays.origin_ego[0, 0].tolist() == [1, 2, 3]


def test_samples_surround_their_pixel_and_average_to_its_centre() -> None:
    rig = make_rig()
    rays = camera_rays(rig, samples_per_pixel=4)
    points_cam = transform_points(inverse_se3(rig.T_ego_cam), rays.origin_ego + rays.dir_ego)
    uv, _, _ = project(points_cam, rig.K, rig.dist, SIZE)
    by_pixel = uv[0].reshape(-1, 4, 2) - pixel_centres(SIZE).reshape(-1, 1, 2)
    torch.testing.assert_close(by_pixel.mean(1), torch.zeros(48, 2), atol=1e-5, rtol=0)
    torch.testing.assert_close(by_pixel[7].abs(), torch.full((4, 2), 0.25), atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match="square"):
        camera_rays(rig, samples_per_pixel=3)


def test_a_rolling_shutter_reads_rows_in_turn() -> None:
    dt_s = camera_rays(make_rig(readout_s=0.06)).dt_s[0].reshape(SIZE)
    torch.testing.assert_close(dt_s[:, 0], torch.tensor([-0.025, -0.015, -0.005, 0.005, 0.015, 0.025]))
    assert (dt_s == dt_s[:, :1]).all()
    assert not camera_rays(dataclasses.replace(make_rig())).dt_s.any()
