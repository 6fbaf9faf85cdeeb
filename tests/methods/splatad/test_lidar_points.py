"""Beams of lidars in tiles, and what they see of simple scenes."""

import math

import torch

from benchmarks.splats import street_range_error_mm
from foredrive.geometry.se3 import exp_se3, inverse_se3, sensor_twist, transform_points
from foredrive.methods.splatad import Gaussians, project_lidar, tiled_lidar_beams
from foredrive.ops.splat_points import LANES, beam_points
from foredrive.ops.splatting import Splats, composite_splats
from foredrive.sensors import TimedRays, pandar64, vlp16

STILL = torch.zeros(6)
TWIST = torch.tensor([12.0, 0.0, 0.0, 0.0, 0.0, 0.3])


def test_every_beam_has_one_slot_and_channels_stay_whole() -> None:
    lidar = pandar64(torch.eye(4))
    points = tiled_lidar_beams(lidar.beams(STILL), torch.eye(4), STILL)
    index = points.index.flatten()
    assert torch.equal(index[index >= 0].sort().values, torch.arange(points.count))
    assert points.count == 64 * 1800
    rows = len(points.lower_edge)
    assert rows > 1
    for row in range(rows):
        tiles = slice(int(points.first_tile[row]), int(points.first_tile[row + 1]))
        held = points.index[tiles].flatten()
        channels = lidar.channel[held[held >= 0]]
        assert len(held[held >= 0]) == 1800 * len(channels.unique())
    wide = points.block_bounds[:, 1] - points.block_bounds[:, 0]
    assert wide.median() < math.radians(1.5)  # 16 beams of 0.2° would be 3° side by side
    assert points.block_bounds.shape[-1] == LANES


def test_beams_look_as_the_sensor_fires_them() -> None:
    """The turn of the vehicle since is undone: elevations are the channels', whatever it does."""
    T = exp_se3(torch.tensor([1.2, 0.0, 1.8, 0.0, 0.02, 0.1]))
    lidar = vlp16(T)
    still, driven = (tiled_lidar_beams(lidar.beams(twist), T, twist) for twist in (STILL, TWIST))
    for points in (still, driven):
        index = points.index.flatten()
        elevation = torch.empty(points.count)
        elevation[index[index >= 0]] = points.position[..., 1].flatten()[index >= 0]
        table = torch.tensor(lidar.elevation_rad)[lidar.channel]
        torch.testing.assert_close(elevation, table, rtol=0, atol=2e-6)


def test_a_moving_lidar_meets_a_point_where_it_is() -> None:
    """The beam that hits a point from the moving sensor passes through its splat, to first order in time."""
    T_ego_lidar = exp_se3(torch.tensor([1.2, 0.3, 1.8, 0.0, 0.0, 0.1], dtype=torch.float64))
    twist = TWIST.double()
    point = torch.tensor([[8.0, 5.0, 0.5]], dtype=torch.float64)
    t_s = torch.tensor([-0.01], dtype=torch.float64)
    T_end_lidar = exp_se3(t_s * twist) @ T_ego_lidar  # the lidar when it fires -> ego frame at time 0
    away = point - T_end_lidar[:3, 3]
    rays = TimedRays(origin_ego=T_end_lidar[None, :3, 3], dir_ego=away / away.norm(), dt_s=t_s)
    beam = tiled_lidar_beams(rays, T_ego_lidar, twist)
    fired = transform_points(inverse_se3(T_end_lidar), point)[0]
    torch.testing.assert_close(beam.position[0, 0, 0], torch.atan2(fired[1], fired[0]))
    one = Gaussians(
        mean_m=point,
        quaternion=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        log_scale=torch.full((1, 3), -4.0, dtype=torch.float64),
        opacity_logit=torch.zeros(1, dtype=torch.float64),
        feature=torch.zeros(1, 1, dtype=torch.float64),
    )
    splat = project_lidar(one, inverse_se3(T_ego_lidar), twist_lidar=sensor_twist(T_ego_lidar, twist))
    then = splat.mean[0] + t_s * splat.velocity[0]
    torch.testing.assert_close(then, beam.position[0, 0], rtol=0, atol=3e-4)
    assert (splat.mean[0] - beam.position[0, 0]).norm() > 5e-3  # it would be missed without
    range_m = splat.range_m + t_s * splat.range_rate_mps
    torch.testing.assert_close(range_m, away.norm(dim=-1), rtol=0, atol=2e-3)


def test_a_wall_all_around_is_where_it_is() -> None:
    """A cylinder of flat Gaussians, 10 m away: beams of an uneven lidar return from it, all around."""
    step = 2 * math.pi / 240
    azimuth, height = torch.meshgrid(torch.arange(240) * step, torch.arange(-8, 5) * 0.5, indexing="ij")
    azimuth, height = azimuth.flatten(), height.flatten()
    count = len(azimuth)
    wall = Gaussians(
        mean_m=torch.stack([10 * azimuth.cos(), 10 * azimuth.sin(), height], -1),
        quaternion=torch.stack(
            [(azimuth / 2).cos(), torch.zeros(count), torch.zeros(count), (azimuth / 2).sin()], -1
        ),
        log_scale=torch.tensor([0.01, 0.3, 0.4]).log().expand(count, 3),
        opacity_logit=torch.full((count,), 4.0),
        feature=torch.ones(count, 1),
    )
    lidar = pandar64(torch.eye(4))
    chosen = (lidar.channel >= 10) & (lidar.channel < 60)  # those that meet the wall well inside its borders
    rays = lidar.beams(STILL)[chosen]
    points = tiled_lidar_beams(rays, torch.eye(4), STILL)
    seen = composite_splats(project_lidar(wall, torch.eye(4)), points)
    assert seen.alpha.min() > 0.95
    expected = 10 / rays.dir_ego[:, :2].norm(dim=-1)
    torch.testing.assert_close(seen.expected_range_m / seen.alpha, expected, rtol=0, atol=0.05)
    torch.testing.assert_close(seen.median_range_m, expected, rtol=0, atol=0.1)


def test_a_splat_across_the_seam_looks_the_same_from_both_sides() -> None:
    azimuth = torch.tensor([3.13, -3.13, 0.0])
    points = beam_points(azimuth, torch.zeros(3), torch.zeros(3))
    one = Splats(
        mean=torch.tensor([[math.pi, 0.0]]),
        inverse_covariance=torch.tensor([[2500.0, 0.0, 2500.0]]),
        opacity=torch.tensor([0.9]),
        range_m=torch.tensor([5.0]),
        range_slope=torch.tensor([[10.0, 0.0]]),
        velocity=torch.zeros(1, 2),
        range_rate_mps=torch.zeros(1),
        feature=torch.ones(1, 1),
    )
    for dtype in (torch.float32, torch.float64):
        seen = composite_splats(Splats(*(field.to(dtype) for field in one)), points)
        d = math.pi - 3.13
        alpha = 0.9 * math.exp(-0.5 * 2500 * d * d)
        expected = torch.tensor([alpha, alpha, 0.0], dtype=dtype)
        torch.testing.assert_close(seen.alpha, expected, rtol=1e-4, atol=1e-5)
        tilted = torch.tensor([5 - 10 * d, 5 + 10 * d], dtype=dtype)
        torch.testing.assert_close(seen.expected_range_m[:2] / seen.alpha[:2], tilted, rtol=1e-4, atol=1e-4)


def test_ranges_of_a_driving_lidar_are_those_of_one_at_rest() -> None:
    """The time of each Gaussian is that of its azimuth: speed costs next to nothing, at the seam either."""
    at_rest, driving, fast = (street_range_error_mm(speed_mps) for speed_mps in (0, 15, 25))
    assert at_rest < 10
    assert driving < 1.1 * at_rest
    assert fast < 1.2 * at_rest
