"""Spinning lidars."""

import math

import torch

from foredrive.sensors import SpinningLidar


def make_lidar() -> SpinningLidar:
    T_ego_lidar = torch.eye(4)
    T_ego_lidar[:3, 3] = torch.tensor([1.0, 0.0, 1.8])
    return SpinningLidar((0.1, -0.2), 360, 10.0, 1.0, 60.0, 0.0, T_ego_lidar)


def test_at_rest_every_beam_leaves_the_sensor_in_its_direction() -> None:
    lidar = make_lidar()
    rays = lidar.beams(torch.zeros(6))
    azimuth = torch.atan2(rays.dir_ego[:, 1], rays.dir_ego[:, 0]).reshape(360, 2)
    elevation = torch.asin(rays.dir_ego[:, 2]).reshape(360, 2)
    torch.testing.assert_close(rays.origin_ego, torch.tensor([1.0, 0.0, 1.8]).expand(720, 3))
    torch.testing.assert_close(elevation, torch.tensor([0.1, -0.2]).expand(360, 2))
    torch.testing.assert_close(azimuth[:, 0], azimuth[:, 1])
    assert math.isclose(azimuth[90, 0].item(), math.pi / 2, abs_tol=0.01)  # clockwise from behind: left first
    assert math.isclose(azimuth[180, 0].item(), 0.0, abs_tol=0.01)
    assert lidar.channel[:4].tolist() == [0, 1, 0, 1]


def test_firing_times_end_at_the_frame() -> None:
    dt_s = make_lidar().beams(torch.zeros(6)).dt_s
    assert math.isclose(dt_s.min().item(), -0.1 + 0.1 / 360, abs_tol=1e-6)
    assert dt_s[-1] == 0
    assert (dt_s[1:] >= dt_s[:-1]).all()


def test_moving_ahead_earlier_beams_leave_from_further_back() -> None:
    rays = make_lidar().beams(torch.tensor([20.0, 0, 0, 0, 0, 0]))
    torch.testing.assert_close(rays.origin_ego[:, 0], 1.0 + 20.0 * rays.dt_s)
    torch.testing.assert_close(rays.dir_ego, make_lidar().beams(torch.zeros(6)).dir_ego)


def test_turning_left_earlier_beams_looked_further_right() -> None:
    still = make_lidar().beams(torch.zeros(6))
    turning = make_lidar().beams(torch.tensor([0.0, 0, 0, 0, 0, 0.5]))
    before, after = (torch.atan2(r.dir_ego[300, 1], r.dir_ego[300, 0]) for r in (still, turning))
    torch.testing.assert_close(after - before, 0.5 * still.dt_s[300], atol=1e-5, rtol=1e-3)
