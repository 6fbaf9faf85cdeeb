"""The expert drives as a vehicle can, where it should, and as one among others."""

from collections.abc import Callable

import numpy as np
import pytest

from foredrive.data.log_writer import EGO_VEHICLE
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.traffic.expert import DriveSnapshot, ExpertDrive
from foredrive.towns.traffic.traffic import Traffic

DT_S = 0.1


def drive(
    town: TownMap, seed: int, seconds: float, vehicles: int = 20
) -> tuple[Traffic, ExpertDrive, list[DriveSnapshot]]:
    traffic = Traffic(town, seed, vehicles, people_count=10)
    driven = ExpertDrive(traffic, seconds)
    return traffic, driven, list(driven.snapshots(round(seconds / DT_S), DT_S))


@pytest.fixture(scope="module", params=[("Town02", 3), ("Town07", 5)], ids=str)
def driven(
    request: pytest.FixtureRequest, town_of: Callable[[str], TownMap]
) -> tuple[Traffic, ExpertDrive, list[DriveSnapshot]]:
    name, seed = request.param
    return drive(town_of(name), seed, seconds=20.0)


def test_the_rear_axle_is_on_the_route(driven: tuple[Traffic, ExpertDrive, list[DriveSnapshot]]) -> None:
    traffic, drive, moments = driven
    line = drive.route.polyline(traffic.lanes)
    steps = np.linspace(line[:-1], line[1:], 10, endpoint=False).reshape(-1, 3)
    for moment in moments[::5]:
        axle = moment.T_world_ego[:3, 3]
        beside = np.linalg.norm(steps - axle, axis=1).min()
        assert beside < (0.15 if np.linalg.norm(axle - line[0]) > 3 else 3.0)


def test_poses_are_rigid_and_level(driven: tuple[Traffic, ExpertDrive, list[DriveSnapshot]]) -> None:
    for moment in driven[2][::10]:
        R = moment.T_world_ego[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert R[2, 1] == pytest.approx(0.0)  # no roll
        assert R[2, 2] > 0.9


def test_motion_is_that_of_a_car(driven: tuple[Traffic, ExpertDrive, list[DriveSnapshot]]) -> None:
    moments = driven[2]
    T = np.array([moment.T_world_ego for moment in moments])
    speed = np.array([moment.twist_ego[0] for moment in moments])
    turn_rate = np.array([moment.twist_ego[5] for moment in moments])
    accel = np.array([moment.acceleration_ego_mps2 for moment in moments])
    step = np.linalg.inv(T[:-1]) @ T[1:]
    np.testing.assert_allclose(step[:, 0, 3], DT_S * 0.5 * (speed[1:] + speed[:-1]), atol=0.03)
    turned = np.arctan2(step[:, 1, 0], step[:, 0, 0])
    # It moves sideways only as far as it turns: the heading is that of the chord to the front axle, so that
    # the rear axle slides, in and out of a curve, by up to a wheelbase times the angle.
    wheelbase_m = driven[1].state.vehicles.wheelbase_m[0]
    assert (np.abs(step[:, 1, 3]) - wheelbase_m * np.abs(turned)).max() < 0.05
    np.testing.assert_allclose(turned / DT_S, 0.5 * (turn_rate[1:] + turn_rate[:-1]), atol=0.25)
    np.testing.assert_allclose(accel[:, 1], speed * turn_rate, atol=1e-9)
    assert np.abs(accel[:, 1]).max() < 4.0
    assert -4.5 < accel[:, 0].min() <= accel[:, 0].max() < 1.6
    jerk = np.diff(accel[:, 0]) / DT_S
    assert np.abs(jerk).max() < 6.0
    along_mps = np.array([np.linalg.norm(moment.twist_ego[:3]) for moment in moments])
    # At the ends of the sharpest curves the axle is slower or faster than the driver for a step.
    assert np.quantile(np.abs(np.diff(along_mps) - DT_S * accel[1:, 0]), 0.98) < 0.05
    # The tightest corners of the maps have a radius of little more than 3 m; the axle hardly cuts them.
    fast = speed > 1.0
    assert (np.abs(turn_rate[fast]) / speed[fast]).max() < 1 / 2.2


def test_velocities_and_turn_rates_are_those_of_the_poses(town02: TownMap) -> None:
    dt_s, count = 0.05, 400
    traffic = Traffic(town02, 1, vehicle_count=20, people_count=0)
    moments = list(ExpertDrive(traffic, 20.0, steering_noise=0.02).snapshots(count, dt_s))
    T = np.array([moment.T_world_ego for moment in moments])
    twist = np.array([moment.twist_ego for moment in moments[1:-1]])
    driven_mps = np.einsum("nji,nj->ni", T[1:-1, :3, :3], T[2:, :3, 3] - T[:-2, :3, 3]) / (2 * dt_s)
    turned = np.linalg.inv(T[:-2]) @ T[2:]
    yaw_radps = np.arctan2(turned[:, 1, 0], turned[:, 0, 0]) / (2 * dt_s)
    assert np.abs(driven_mps[:, 1]).max() > 0.5  # it does drive curves
    assert np.quantile(np.linalg.norm(twist[:, :3] - driven_mps, axis=1), 0.95) < 0.1
    assert np.quantile(np.abs(twist[:, 5] - yaw_radps), 0.95) < 0.02
    off_mps, across_mps = [], []
    for before, now, after in zip(moments[:-2:5], moments[1:-1:5], moments[2::5], strict=True):
        at = [{a.track_id: a.centre_m for a in moment.actors} for moment in (before, after)]
        for actor in now.actors:
            if all(actor.track_id in centres for centres in at):
                centre_mps = (at[1][actor.track_id] - at[0][actor.track_id]) / (2 * dt_s)
                off_mps.append(np.linalg.norm(actor.velocity_mps - centre_mps))
                left = np.array([-np.sin(actor.yaw), np.cos(actor.yaw), 0.0])
                across_mps.append(abs(left @ centre_mps))
    assert np.max(across_mps) > 0.2  # some of them turn or change lanes
    assert np.quantile(off_mps, 0.95) < 0.1


def test_the_drive_gets_somewhere_and_turns(driven: tuple[Traffic, ExpertDrive, list[DriveSnapshot]]) -> None:
    moments = driven[2]
    speed = np.array([moment.twist_ego[0] for moment in moments])
    assert speed[0] > 3.0
    assert speed.mean() > 1.0
    assert np.sum(DT_S * speed) > 20.0


def test_nobody_touches_the_ego_vehicle(driven: tuple[Traffic, ExpertDrive, list[DriveSnapshot]]) -> None:
    for moment in driven[2][::3]:
        T_ego_world = np.linalg.inv(moment.T_world_ego)
        for actor in moment.actors:
            at = T_ego_world[:3, :3] @ actor.centre_m + T_ego_world[:3, 3]
            beside = abs(at[1]) > 0.5 * (EGO_VEHICLE.width + actor.size_lwh[1])
            reach = 0.5 * (EGO_VEHICLE.length + actor.size_lwh[0])
            ahead_or_behind = abs(at[0] - EGO_VEHICLE.rear_axle_to_center_longitudinal) > reach
            heading = np.cos(actor.yaw - np.arctan2(moment.T_world_ego[1, 0], moment.T_world_ego[0, 0]))
            if abs(heading) > 0.99:  # side by side or in line: boxes are aligned
                assert beside or ahead_or_behind, moment.t_s
            else:
                assert np.hypot(at[0] - 1.65, at[1]) > 0.9


def test_traffic_appears_and_disappears_out_of_sight(town_of: Callable[[str], TownMap]) -> None:
    _, _, moments = drive(town_of("Town07"), seed=3, seconds=15.0, vehicles=25)
    seen: dict[int, int] = {}
    for index, moment in enumerate(moments):
        ego = moment.T_world_ego[:3, 3]
        for actor in moment.actors:
            distance = np.linalg.norm(actor.centre_m - ego)
            if actor.track_id not in seen and index > 0:
                assert distance > 80.0, f"{actor.category} appeared at {distance:.0f} m"
            seen[actor.track_id] = index
    last = {track: index for track, index in seen.items() if index < len(moments) - 1}
    for track, index in last.items():
        actor = next(a for a in moments[index].actors if a.track_id == track)
        assert np.linalg.norm(actor.centre_m - moments[index].T_world_ego[:3, 3]) > 80.0


def test_moments_do_not_depend_on_how_often_one_looks(town02: TownMap) -> None:
    often = drive(town02, 1, 3.0)[2]
    seldom = list(ExpertDrive(Traffic(town02, 1, 20, people_count=10), 3.0).snapshots(6, 0.5))
    for index, moment in enumerate(seldom):
        np.testing.assert_allclose(moment.T_world_ego, often[5 * index].T_world_ego, atol=1e-9)
        assert moment.t_s == pytest.approx(often[5 * index].t_s)


def test_the_lights_of_a_moment_are_those_of_its_stop_zones(town02: TownMap) -> None:
    traffic, _, moments = drive(town02, 1, 1.0)
    assert moments[0].lights.shape == (len(town02.stop_zones),)
    assert set(moments[0].lights.tolist()) <= {1, 2, 3}  # all of this town's zones have lights
    np.testing.assert_array_equal(traffic.lanes.zone[traffic.signals.guarded] >= 0, True)
