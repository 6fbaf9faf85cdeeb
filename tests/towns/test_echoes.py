"""What a beam's footprint makes of edges."""

import dataclasses

import numpy as np
import pytest
import torch

from foredrive.scene import Category
from foredrive.scene.actors import ActorState
from foredrive.sensors import SpinningLidar
from foredrive.sensors.rigs import camera_rig
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.sensing.echoes import footprint_chance, group_echoes, pick_echo
from foredrive.towns.world import World


def test_rays_within_a_pulse_are_one_echo() -> None:
    t = np.array([[10.2, 30.0, 10.0, 30.5], [np.inf, 5.0, 6.0, np.inf]], np.float32)
    group, share = group_echoes(t, 0.75)
    assert group[0].tolist() == [0, 1, 0, 1]
    assert share[0].tolist() == [0.5] * 4
    assert group[1, [1, 2]].tolist() == [0, 1]
    assert share[1, [1, 2]].tolist() == [0.25, 0.25]


def test_the_strongest_echo_is_returned_or_the_last() -> None:
    group, _ = group_echoes(np.array([[10.2, 30.0, 10.0, 30.5]], np.float32), 0.75)
    rays = (
        np.array([10.2, 30.0, 10.0, 30.5], np.float32),
        np.array([True, True, True, False]),
        np.array([0.1, 0.8, 0.3, 0.0], np.float32),
    )
    (range_m, returned, intensity), ray = pick_echo(group, rays, False)
    assert returned.all()
    assert range_m[0] == pytest.approx((0.1 * 10.2 + 0.3 * 10.0) / 0.4)  # 0.4 / 10² against 0.8 / 30²
    assert intensity[0] == pytest.approx(0.1)
    assert ray[0] == 2
    (range_m, _, intensity), ray = pick_echo(group, rays, True)
    assert (range_m[0], intensity[0], ray[0]) == (pytest.approx(30.0), pytest.approx(0.2), 1)
    nothing = (rays[0], np.zeros(4, np.bool_), np.zeros(4, np.float32))
    (range_m, returned, intensity), ray = pick_echo(group, nothing, False)
    assert (range_m[0], returned[0], intensity[0], ray[0]) == (10.0, False, 0.0, 2)


def test_an_echo_of_a_part_of_a_beam_is_lost_as_a_weaker_one() -> None:
    chance = np.linspace(0.01, 0.99, 99, dtype=np.float32)[:, None]
    echo, threshold, share = 0.05, 0.02, 0.25
    asked = footprint_chance(chance, np.full((99, 1), share, np.float32))[:, 0]
    kept = asked < echo / (echo + threshold)
    expected = share * echo / (share * echo + threshold)
    assert kept.tolist() == (chance[:, 0] < expected).tolist()


def box(T_world_ego: np.ndarray, x_m: float, y_m: float, width_m: float, track_id: int) -> ActorState:
    R = T_world_ego[:3, :3]
    return ActorState(
        track_id=track_id,
        category=Category.BARRIER,  # drawn as its box
        centre_m=R @ [x_m + 0.05, y_m, 3.0] + T_world_ego[:3, 3],
        yaw=float(np.arctan2(R[1, 0], R[0, 0])),
        pitch=0.0,
        size_lwh=np.array([0.1, width_m, 6.0]),
        velocity_mps=np.zeros(3),
        style=5,
        parked=False,
    )


def test_divergence_softens_edges(world02: World, town02: TownMap) -> None:
    """A screen before a wall: where the pulse is longer than the gap, ranges pass from one to the other."""
    lane = max((x for x in town02.lanes if x.junction_id is None), key=lambda x: len(x.centreline_xyz))
    k = len(lane.centreline_xyz) // 2
    T = np.eye(4)
    T[:3, 3] = lane.centreline_xyz[k]
    T_ego_lidar = torch.eye(4)
    T_ego_lidar[2, 3] = 1.6
    ideal = SpinningLidar((0.0,), 20_000, 10.0, 0.5, 60.0, 0.0, T_ego_lidar)
    wide = dataclasses.replace(ideal, divergence_rad=0.02, rays_per_beam=24)

    def ranges(lidar: SpinningLidar, wall_m: float) -> np.ndarray:
        actors = [box(T, 10.0, 5.0, 10.0, 1), box(T, wall_m, 0.0, 30.0, 2)]  # the screen's edge at y = 0
        sensors = SensorSuite(camera_rig((2, 2)), lidar)
        sweep = world02.render(actors, sensors, T, np.zeros(6), noise_seed=0).sweep
        azimuth = torch.atan2(sweep.dir_ego[:, 1], sweep.dir_ego[:, 0])
        near_edge = sweep.returned & (azimuth.abs() < 0.015)
        return (sweep.range_m * azimuth.cos())[near_edge].numpy()

    def between(range_m: np.ndarray, wall_m: float) -> int:
        return int(((range_m > 10.03) & (range_m < wall_m - 0.03)).sum())

    assert between(ranges(ideal, 10.5), 10.5) == 0
    assert between(ranges(wide, 10.5), 10.5) > 30  # of the 64 beams within the divergence of the edge
    assert between(ranges(wide, 14.0), 14.0) == 0  # two echoes: one of them is returned
    strongest = (ranges(wide, 14.0) < 12.0).sum()
    last = (ranges(dataclasses.replace(wide, echo="last"), 14.0) < 12.0).sum()
    assert last < strongest - 30
