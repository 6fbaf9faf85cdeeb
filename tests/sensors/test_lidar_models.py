"""Lidars of real cars, and what tells their beams from ideal rays."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from foredrive.scene import LidarSweep
from foredrive.sensors import SpinningLidar, hdl32e, pandar64, vlp16
from foredrive.sensors.lidar_estimation import estimate_lidar

STILL = torch.zeros(6)
HDL32E_FIRING_DEG = (
    *(-30.67, -9.33, -29.33, -8.00, -28.00, -6.66, -26.66, -5.33, -25.33, -4.00, -24.00, -2.67, -22.67),
    *(-1.33, -21.33, 0.00, -20.00, 1.33, -18.67, 2.67, -17.33, 4.00, -16.00, 5.33, -14.67, 6.67, -13.33),
    *(8.00, -12.00, 9.33, -10.67, 10.67),
)
"""User's manual of the HDL-32E, page 10: in the order of firing."""


def test_hdl32e_fires_as_in_its_manual() -> None:
    lidar = hdl32e(torch.eye(4), rate_hz=20.0)
    assert lidar.firing_s is not None
    order = sorted(range(32), key=lidar.firing_s.__getitem__)
    fired_deg = [math.degrees(lidar.elevation_rad[k]) for k in order]
    assert fired_deg == pytest.approx(HDL32E_FIRING_DEG, abs=0.011)
    assert lidar.firing_s[order[5]] == pytest.approx(5 * 1.152e-6)
    assert 1083 <= lidar.azimuth_steps <= 1086  # nuScenes: 34 720 points a sweep or somewhat less
    assert 1.0 / (lidar.rate_hz * lidar.azimuth_steps) == pytest.approx(46.08e-6, rel=1e-3)


def test_vlp16_fires_its_lasers_in_turn() -> None:
    lidar = vlp16(torch.eye(4))
    assert lidar.firing_s is not None
    order = sorted(range(16), key=lidar.firing_s.__getitem__)
    fired_deg = [math.degrees(lidar.elevation_rad[k]) for k in order]
    assert fired_deg == pytest.approx([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
    assert 1.0 / (lidar.rate_hz * lidar.azimuth_steps) == pytest.approx(55.296e-6, rel=1e-3)


def test_pandar64_is_dense_about_the_horizon() -> None:
    lidar = pandar64(torch.eye(4))
    elevation_deg = torch.tensor(lidar.elevation_rad).rad2deg()
    step_deg = -elevation_deg.diff()
    dense = (elevation_deg[:-1] < 2.1) & (elevation_deg[:-1] > -6.0)
    assert len(elevation_deg) == 64
    assert dense.sum() == 48
    assert ((step_deg[dense] > 0.15) & (step_deg[dense] < 0.18)).all()
    assert (step_deg[~dense] > 0.8).all()
    assert elevation_deg[0] == pytest.approx(14.882)
    assert elevation_deg[63] == pytest.approx(-24.897)
    assert lidar.firing_s is not None
    assert lidar.firing_s[11] == lidar.firing_s[39] == 0.0  # the manual: the longest before the block's end
    assert lidar.firing_s[50] == lidar.firing_s[60] == pytest.approx(51.048e-6, abs=1e-9)
    assert sorted(lidar.firing_s)[::2] == sorted(lidar.firing_s)[1::2]  # two at a time


def test_a_channel_looks_beside_its_column() -> None:
    lidar = dataclasses.replace(pandar64(torch.eye(4)), firing_s=None)
    rays = lidar.beams(STILL)[torch.arange(900 * 64, 901 * 64)]
    azimuth_deg = torch.atan2(rays.dir_ego[:, 1], rays.dir_ego[:, 0]).rad2deg()
    torch.testing.assert_close(
        azimuth_deg[8] - azimuth_deg[0], torch.tensor(-5.208 - 1.042), atol=1e-3, rtol=0
    )
    torch.testing.assert_close(torch.asin(rays.dir_ego[:, 2]), torch.tensor(lidar.elevation_rad))


def test_the_head_turns_and_the_vehicle_moves_while_a_column_fires() -> None:
    firing_s = (0.0, 40e-6)
    lidar = SpinningLidar((0.0, 0.0), 1000, 10.0, 1.0, 60.0, 0.0, torch.eye(4), firing_s)
    rays = lidar.beams(torch.tensor([25.0, 0, 0, 0, 0, 0]))
    azimuth = torch.atan2(rays.dir_ego[:, 1], rays.dir_ego[:, 0]).reshape(1000, 2)
    dt_s, x = rays.dt_s.reshape(1000, 2), rays.origin_ego[:, 0].reshape(1000, 2)
    assert dt_s[-1].tolist() == pytest.approx([-40e-6, 0.0])
    turned = azimuth[100:900, 0] - azimuth[100:900, 1]  # clockwise
    torch.testing.assert_close(turned, torch.full((800,), 40e-6 * 10 * 2 * math.pi), atol=1e-5, rtol=0)
    torch.testing.assert_close(x[:, 1] - x[:, 0], torch.full((1000,), 25 * 40e-6), atol=1e-5, rtol=0)


def test_a_footprint_fills_the_cone() -> None:
    lidar = dataclasses.replace(vlp16(torch.eye(4)), azimuth_steps=36, rays_per_beam=16)
    beams = lidar.beams(STILL)
    rays = lidar.footprints(beams)
    axis = beams.dir_ego[:, None].double()
    angle = rays.dir_ego.reshape(-1, 16, 3).double().cross(axis.expand(-1, 16, 3), dim=-1).norm(dim=-1)
    expected = 0.5 * lidar.divergence_rad * ((torch.arange(16) + 0.5) / 16).sqrt().double()
    torch.testing.assert_close(angle, expected.expand_as(angle), atol=2e-6, rtol=0)
    mean = rays.dir_ego.reshape(-1, 16, 3).mean(1)
    assert ((mean - beams.dir_ego).norm(dim=-1) < 0.1 * lidar.divergence_rad).all()
    torch.testing.assert_close(rays.dt_s, beams.dt_s.repeat_interleave(16))


def test_a_lidar_is_estimated_from_the_beams_that_it_fires() -> None:
    T_ego_lidar = torch.eye(4)
    T_ego_lidar[:3, 3] = torch.tensor([1.0, 0.2, 1.8])
    lidar = SpinningLidar((-0.2, 0.0, 0.1), 90, 20.0, 1.0, 60.0, 0.0, T_ego_lidar)
    twist = torch.tensor([10.0, 0.0, 0.0, 0.0, 0.0, 0.3])
    beams, count = lidar.beams(twist), 3 * 90
    yes = torch.ones(count, dtype=torch.bool)
    sweep = LidarSweep(
        beams.origin_ego, beams.dir_ego, torch.full((count,), 7.0), yes, torch.zeros(count), beams.dt_s,
        lidar.channel, yes,
    )  # fmt: skip
    found = estimate_lidar(sweep, twist, period_s=0.1, reach_m=60.0)
    assert found is not None
    assert (found.azimuth_steps, found.max_range_m, found.min_range_m) == (90, 60.0, 7.0)
    assert found.rate_hz == pytest.approx(20.0, rel=1e-4)
    assert found.elevation_rad == pytest.approx(lidar.elevation_rad, abs=1e-5)
    torch.testing.assert_close(found.T_ego_lidar, T_ego_lidar, atol=1e-4, rtol=0)
    unknown = dataclasses.replace(sweep, beam=torch.full((count,), -1))
    assert estimate_lidar(unknown, twist, period_s=0.1, reach_m=60.0) is None


def test_tables_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="2 channels, but a table of 1"):
        SpinningLidar((0.0, 0.1), 360, 10.0, 1.0, 60.0, 0.0, torch.eye(4), firing_s=(0.0,))
    with pytest.raises(ValueError, match="fire longer than"):
        SpinningLidar((0.0, 0.1), 1000, 10.0, 1.0, 60.0, 0.0, torch.eye(4), firing_s=(0.0, 2e-4))


@pytest.mark.real
def test_a_real_hdl32e_looks_where_ours_does(real_data: Path) -> None:
    """The upper rings of nuScenes' lidar; the lower ones end on the car's roof or too near to tell."""
    sweep = next((real_data / "nuscenes" / "keyframe").glob("*LIDAR_TOP*.pcd.bin"))
    points = np.fromfile(sweep, np.float32).reshape(-1, 5)
    range_m, ring = np.linalg.norm(points[:, :3], axis=1), points[:, 4]
    elevation_deg = np.rad2deg(np.arcsin(points[:, 2] / range_m.clip(1e-6)))
    far = range_m > 5.0
    ours = hdl32e(torch.eye(4), rate_hz=20.0)
    for k in range(12, 32):
        measured = np.median(elevation_deg[far & (ring == k)])
        assert measured == pytest.approx(math.degrees(ours.elevation_rad[k]), abs=0.06)
    assert abs((ring == 20).sum() - ours.azimuth_steps) <= 1
