"""The expert steers back to its path after a disturbance."""

import itertools

import numpy as np
import pytest

from foredrive.errors import InputError
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.traffic.expert import ExpertDrive
from foredrive.towns.traffic.recovery import LATERAL_MPS2, MAX_OFFSET_M, PathDeviation, step_deviation
from foredrive.towns.traffic.traffic import Traffic

DT_S = 0.1


@pytest.mark.parametrize("speed_mps", [6.0, 13.0, 30.0])
def test_the_expert_is_back_within_seconds_and_does_not_overshoot(speed_mps: float) -> None:
    rng = np.random.default_rng(0)
    deviation, aside = PathDeviation(lateral_m=0.8, yaw_rad=0.02, next_s=np.inf), []
    for _ in range(70):
        deviation = step_deviation(deviation, speed_mps, 2.8, 0.0, DT_S, rng)
        aside.append(deviation.lateral_m)
    assert abs(aside[-1]) < 0.05
    assert abs(deviation.yaw_rad) < 0.01
    assert min(aside) > -0.08


def test_disturbances_push_the_vehicle_aside_but_not_off_its_lane() -> None:
    rng, deviation = np.random.default_rng(3), PathDeviation()
    swayed = []
    for _ in range(6000):
        deviation = step_deviation(deviation, 12.0, 2.8, 0.02, DT_S, rng)
        swayed.append(deviation)
    aside = np.array([s.lateral_m for s in swayed])
    yaw = np.array([s.yaw_rad for s in swayed])
    assert 0.3 < np.abs(aside).max() < MAX_OFFSET_M
    assert np.median(np.abs(aside)) < 0.1  # on its path most of the time
    assert max(abs(s.curvature) for s in swayed) * 12.0**2 <= LATERAL_MPS2 + 1e-9
    # It goes where it points: no step to the side without a heading for it.
    slope = 0.5 * (yaw[1:] + yaw[:-1])
    np.testing.assert_allclose(np.diff(aside), 1.2 * np.sin(slope), atol=1e-6)


def test_a_vehicle_that_stands_does_not_slide() -> None:
    deviation = PathDeviation(lateral_m=0.4, yaw_rad=0.05, next_s=-1.0, noise=0.05)
    moved = step_deviation(deviation, 0.0, 2.8, 0.05, DT_S, np.random.default_rng(0))
    assert (moved.lateral_m, moved.yaw_rad) == (0.4, 0.05)


def test_a_disturbed_drive_stays_near_the_flawless_one(town02: TownMap) -> None:
    drives = [ExpertDrive(Traffic(town02, 1, 6, 0), 15.0, steering_noise=noise) for noise in (0.0, 0.03)]
    flawless, disturbed = (list(drive.snapshots(150, DT_S)) for drive in drives)
    beside = np.array(
        [
            (np.linalg.inv(a.T_world_ego) @ b.T_world_ego)[:2, 3]
            for a, b in zip(flawless, disturbed, strict=True)
        ]
    )
    np.testing.assert_allclose(beside[:, 0], 0.0, atol=1e-9)  # the same speed
    assert 0.05 < np.abs(beside[:, 1]).max() < MAX_OFFSET_M
    for before, after in itertools.pairwise(disturbed):
        step = np.linalg.inv(before.T_world_ego) @ after.T_world_ego
        assert abs(step[1, 3]) < 0.15
        turned = np.arctan2(step[1, 0], step[0, 0]) / DT_S
        assert turned == pytest.approx(0.5 * (before.twist_ego[5] + after.twist_ego[5]), abs=0.3)


def test_the_outline_of_the_ego_vehicle_sways_with_it(town02: TownMap) -> None:
    traffic = Traffic(town02, 1, 6, 0)
    drive = ExpertDrive(traffic, 15.0, steering_noise=0.03)
    lateral_m = []
    for moment in drive.snapshots(100, DT_S):
        poses = drive.poses()
        T_ego_world = np.linalg.inv(moment.T_world_ego)
        size_m = drive.state.vehicles.size_lwh[0]
        expected_ego = [drive.state.vehicles.axle_to_centre_m[0], 0.0, size_m[2] / 2, 1.0]
        np.testing.assert_allclose(T_ego_world @ [*poses.centre_m[0], 1.0], expected_ego, atol=1e-9)
        np.testing.assert_allclose(T_ego_world[:3, :3] @ poses.forward[0], [1.0, 0.0, 0.0], atol=1e-9)
        on_path = traffic.poses(drive.state)
        np.testing.assert_array_equal(poses.centre_m[1:], on_path.centre_m[1:])
        lateral_m.append(np.linalg.norm(poses.axle_xyz[0] - on_path.axle_xyz[0]))
    assert lateral_m[0] == pytest.approx(0.0, abs=1e-9)
    assert max(lateral_m) > 0.05


def test_noise_is_not_negative(town02: TownMap) -> None:
    with pytest.raises(InputError, match="steering noise"):
        ExpertDrive(Traffic(town02, 1, 2, 0), 1.0, steering_noise=-0.1)
