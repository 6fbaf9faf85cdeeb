"""Affordances of a made-up street: the light and who is in the path, worked out by hand."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
from flat_street import street
from py123d.datatypes import StopZone, StopZoneType, TrafficLightStatus
from py123d.geometry import Polyline3D

from foredrive.data import LogPath, find_logs
from foredrive.data.clip_config import TaskTruthConfig
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.data.maps import write_map
from foredrive.data.truth.affordances import read_affordances, read_stop_lines
from foredrive.data.truth.store import TaskTruthStore
from foredrive.geometry.path_frame import along_path, path_headings
from foredrive.scene import Boxes, Category, VoxelSpec
from foredrive.scene.boxes import unlabelled
from foredrive.scene.traffic_light import LightState

YAW = 0.2
"""The vehicle is turned by this against the street, as while it is steered aside."""
LINE_X, LEAD_REAR_X, WALKER_X = 18.0, 25.0, 16.0
ROUTE = np.stack([np.arange(-20.0, 61.0), np.zeros(81), np.zeros(81)], -1) + world.WORLD_OFFSET
FRAME = 10
"""The rear axle is at x = 5 then."""
LIGHTS = {5: TrafficLightStatus.RED, 4: TrafficLightStatus.GREEN}
"""Lane 5 begins at the line; lane 4 leads the other way."""
LAMPS = {5: np.add(world.WORLD_OFFSET, [[20.0, -3.0, 2.5], [20.0, 0.0, 5.0]]), 4: np.zeros((1, 3))}
STATES = (TrafficLightStatus.RED, TrafficLightStatus.GREEN)
"""Before and from frame 30 on, two seconds after `FRAME`."""


def actors(t_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres and velocities: a lead car, a parked one, people who cross, walk along and cross too late."""
    walk = 1.2
    centre = [
        [LEAD_REAR_X + 2.0 + 3.0 * (t_s - 1.0), 0.5, 1.0],
        [15.0, 4.0, 1.0],
        [WALKER_X, 5.0 - walk * (t_s - 1.0), 0.9],
        [WALKER_X, -3.0, 0.9],
        [WALKER_X, 8.0 - walk * (t_s - 1.0), 0.9],
    ]
    velocity = [[3.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, -walk, 0.0], [0.0, 0.0, 0.0], [0.0, -walk, 0.0]]
    return np.array(centre), np.array(velocity)


def frame(index: int) -> world.Frame:
    plain = world.frame(index, [])
    R = np.array([[math.cos(YAW), -math.sin(YAW), 0], [math.sin(YAW), math.cos(YAW), 0], [0, 0, 1]])
    pose = plain.T_world_ego.copy()
    pose[:3, :3] = R
    t_s = index * world.PERIOD_US * 1e-6
    centre, velocity = actors(t_s)
    kinds = [Category.CAR, Category.CAR, *[Category.PEDESTRIAN] * 3]
    boxes = Boxes(
        centre=torch.from_numpy((centre - world.driven(t_s)) @ R).float(),
        size_lwh=torch.tensor([[4.0, 2.0, 2.0]] * 2 + [[0.5, 0.6, 1.8]] * 3),
        yaw=torch.full((5,), -YAW),
        velocity=torch.from_numpy(velocity @ R)[:, :2].float(),
        track_id=torch.arange(5),
        category=torch.tensor([int(kind) for kind in kinds]),
        valid=torch.ones(5, dtype=torch.bool),
        **unlabelled(5),
    )
    return dataclasses.replace(
        plain,
        T_world_ego=pose,
        boxes=boxes,
        traffic_lights=LIGHTS | {5: STATES[index >= 30]},
        signal_lamps=LAMPS,
    )


def written(root: Path, route: np.ndarray | None) -> LogPath:
    maps_dir = write_map(street(), "Flatland", root)
    with LogWriter(root, "flat_train", "log", [], maps_dir, "Flatland", route) as writer:
        for index in range(0, 60, 5):
            writer.write(frame(index))
    return find_logs(root)[0]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    return Log(written(tmp_path_factory.mktemp("lights"), ROUTE))


def test_stop_lines_lie_across_their_lanes(log: Log) -> None:
    (state, ends), (other, _) = sorted(read_stop_lines(log, FRAME // 5))
    assert (state, other) == (LightState.RED, LightState.GREEN)
    left = np.array([LINE_X, 1.5]) + world.WORLD_OFFSET[:2]
    assert ends == pytest.approx(np.stack([left, left - [0.0, 3.0]]))
    later = [state for state, _ in read_stop_lines(log, 8)]
    assert later == [LightState.GREEN, LightState.GREEN]


def front_x(log: Log) -> float:
    centre, size = log.ego_box
    return 5.0 + float(centre[0] + 0.5 * size[0])


def test_light_and_lead_vehicle_on_the_route(log: Log) -> None:
    """Distances run along the route, whichever way the vehicle points."""
    found = read_affordances(log, FRAME // 5)
    assert (bool(found.light_known), LightState(int(found.light))) == (True, LightState.RED)
    assert float(found.light_m) == pytest.approx(LINE_X - front_x(log), abs=0.02)
    assert bool(found.lamps_known)
    ahead = torch.tensor([[15.0, -3.0, 2.5], [15.0, 0.0, 5.0]])
    back = torch.tensor([[math.cos(YAW), -math.sin(YAW)], [math.sin(YAW), math.cos(YAW)]])
    in_street = torch.cat([found.lamp_xyz[:, :2] @ back.T, found.lamp_xyz[:, 2:]], dim=-1)
    torch.testing.assert_close(in_street, ahead, atol=2e-3, rtol=0)
    assert bool(found.lead & found.lead_known)
    assert float(found.lead_m) == pytest.approx(LEAD_REAR_X - front_x(log), abs=0.02)
    assert float(found.lead_mps) == pytest.approx(3.0, abs=0.01)


def test_the_next_stop_sign_is_that_of_the_map(log: Log, tmp_path: Path) -> None:
    """The sign's lane begins at the line of the light; that of the bridge is on another level."""
    found = read_affordances(log, FRAME // 5)
    assert not bool(found.sign | found.sign_known)  # its map has no stop zones
    corners = np.array([[17.0, -1.75, 0.0], [18.0, -1.75, 0.0], [18.0, 1.75, 0.0], [17.0, -1.75, 0.0]])
    outline = Polyline3D.from_array(corners + world.WORLD_OFFSET)
    for kind, lane, there in (
        (StopZoneType.UNKNOWN, 5, None),
        (StopZoneType.STOP_SIGN, 5, True),
        (StopZoneType.TRAFFIC_LIGHT, 5, False),
        (StopZoneType.STOP_SIGN, 6, False),
        (StopZoneType.STOP_SIGN, 4, False),
    ):
        folder = tmp_path / f"{kind.name}_{lane}"
        maps_dir = write_map([*street(), StopZone(9, kind, outline, lane_ids=[lane])], "Flatland", folder)
        with LogWriter(folder, "flat_train", "log", [], maps_dir, "Flatland", ROUTE) as writer:
            for index in range(0, 30, 5):
                writer.write(frame(index))
        found = read_affordances(Log(find_logs(folder)[0]), FRAME // 5)
        assert (bool(found.sign_known), bool(found.sign)) == (there is not None, bool(there)), (kind, lane)
        assert float(found.sign_m) == pytest.approx((LINE_X - front_x(log)) * bool(there), abs=0.02)


def test_cells_of_the_path_are_occupied_over_time(log: Log) -> None:
    """The lead car drives on at 3 m/s; the first walker enters after 2.9 s, the last one later than 4 s."""
    found = read_affordances(log, FRAME // 5)
    assert bool(found.occupied_known.all())
    for step in range(9):
        rear_m = LEAD_REAR_X - front_x(log) + 1.5 * step
        cells = set(range(int(rear_m // 2), int((rear_m + 4.0) // 2) + 1))
        cells |= {int((WALKER_X - front_x(log)) // 2)} if step >= 6 else set()
        assert set(found.occupied[step].nonzero()[:, 0].tolist()) == cells, step
    late = read_affordances(log, 7)  # the log ends after 2 s, the route 42 m ahead of the axle
    assert late.occupied_known.any(1).tolist() == [True] * 5 + [False] * 4
    assert late.occupied_known[0].tolist() == [True] * 18 + [False] * 6


def test_lights_behind_and_far_ahead_do_not_count(log: Log) -> None:
    near = read_affordances(log, 7)  # the axle is at x = 17.5, the bumper 3.6 m beyond the line
    assert int(near.light) == LightState.GREEN  # the point that is judged has not crossed it
    late = read_affordances(log, 8)
    assert (bool(late.light_known), int(late.light)) == (True, LightState.NONE)


def test_without_a_route_the_driven_path_counts_and_lights_are_unknown(tmp_path: Path) -> None:
    found = read_affordances(Log(written(tmp_path, None)), FRAME // 5)
    assert not bool(found.light_known)
    assert not bool(found.lamps_known)
    assert bool(found.lead)
    assert int(found.path_valid.sum()) == 23  # 22.5 m are left


def test_the_store_reads_them_beside_its_cache(log: Log, tmp_path: Path) -> None:
    spec = VoxelSpec((-4.0, -4.0, -1.0), 1.0, (2, 8, 8))
    config = TaskTruthConfig(elements_lw_m=None, raster=None, semantics=None, instances=None)
    with_them = dataclasses.replace(config, affordances=True)
    assert TaskTruthStore(tmp_path, config, spec).read(log, 2, []).affordances is None
    again = TaskTruthStore(tmp_path, with_them, spec).read(log, 2, []).affordances
    assert again is not None
    assert int(again.light) == LightState.RED


def test_positions_along_a_path_with_a_corner_and_an_end() -> None:
    path = torch.tensor([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 0.0]])
    valid = torch.tensor([True, True, True, False])
    points = torch.tensor([[4.0, 1.5], [12.0, 5.0], [10.0, 13.0], [-2.0, 0.0]])
    along, left = along_path(points.expand(2, 4, 2), path.expand(2, 4, 2), valid.expand(2, 4))
    torch.testing.assert_close(along[1], torch.tensor([4.0, 15.0, 20.0, 0.0]))
    torch.testing.assert_close(left[1].abs(), torch.tensor([1.5, 2.0, 3.0, 2.0]))
    assert left[0, 0] > 0 > left[0, 1]
    heading = path_headings(torch.tensor([3.0, 17.0, 30.0]), path, valid)
    torch.testing.assert_close(heading, torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]))
    nowhere = along_path(points, path, torch.zeros(4, dtype=torch.bool))[1]
    assert nowhere.isinf().all()
