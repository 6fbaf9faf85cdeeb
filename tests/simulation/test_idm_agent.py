"""The rule-based agent: distances behind obstacles by hand, and a drive through a town."""

import numpy as np
import pytest
import torch

from foredrive.data.affordances import PathAhead, path_ahead
from foredrive.geometry.polylines import arc_lengths
from foredrive.scene.affordances import AffordanceEstimate
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.scene.traffic_light import LightState
from foredrive.simulation.drive import drive_route
from foredrive.simulation.idm_agent import (
    DESIRED_MPS,
    STANDSTILL_M,
    IdmAgent,
    Obstacle,
    _curve_speed,
    _told,
    _waypoints,
    drive_along,
)
from foredrive.simulation.scores import Ending
from foredrive.simulation.town import TownScenario, TownSimulator
from foredrive.towns.map.town_map import load_town_map
from foredrive.towns.traffic.traffic import Traffic

FRONT_M = 4.1


def path(xyz: np.ndarray | None = None, pose: np.ndarray | None = None) -> PathAhead:
    line = np.stack([np.arange(100.0), np.zeros(100), np.zeros(100)], -1) if xyz is None else xyz
    return path_ahead(line, arc_lengths(line), 0.0, np.eye(4) if pose is None else pose, FRONT_M)


def test_it_speeds_up_to_its_speed_and_keeps_it() -> None:
    along = drive_along(path(), 0.0, [])
    assert (np.diff(along, prepend=0.0) > 0).all()
    assert along[-1] < DESIRED_MPS * 3
    cruising = np.diff(drive_along(path(), DESIRED_MPS, []), prepend=0.0)
    np.testing.assert_allclose(cruising, DESIRED_MPS * 0.5, rtol=0.02)


@pytest.mark.parametrize("gap_m", [25.0, 18.0])
def test_it_stops_before_what_stands(gap_m: float) -> None:
    speed, done = DESIRED_MPS, 0.0
    for _ in range(30):  # plans anew every half second
        along = drive_along(path(), speed, [Obstacle(gap_m - done, 0.0)])
        speed, done = float(along[0]) / 0.5 if along[0] > 0.02 else 0.0, done + float(along[0])
    assert speed < 0.1
    assert gap_m - STANDSTILL_M - 1.5 < done < gap_m


def test_it_follows_at_the_speed_of_the_leader() -> None:
    along = drive_along(path(), 4.0, [Obstacle(8.0, 4.0)])
    assert np.diff(along)[-1] / 0.5 == pytest.approx(4.0, abs=0.6)


def test_it_slows_down_before_a_corner_and_comes_back_to_its_line() -> None:
    turn = np.concatenate(
        [
            np.stack([np.arange(8.0), np.zeros(8)], -1),
            [[8, 1], [8, 2], [8, 3], [8, 4]],
            np.stack([np.full(30, 8.0), np.arange(5.0, 35.0)], -1),
        ]
    )
    corner = path(np.column_stack([turn, np.zeros(len(turn))]))
    assert _curve_speed(corner) < 4.0 < DESIRED_MPS == _curve_speed(path())
    pose = np.eye(4)
    pose[1, 3] = 1.0  # a metre to the left
    beside = _waypoints(path(pose=pose), np.array([0.0, 8.0, 60.0]))
    np.testing.assert_allclose(beside[:, 1], [0.0, -1 + np.exp(-1), -1 + np.exp(-7.5)], atol=1e-6)


def test_what_a_model_tells_is_obeyed_where_it_is_probable() -> None:
    estimate = AffordanceEstimate(
        light=torch.eye(4)[[LightState.RED]],
        light_m=torch.tensor([12.0]),
        lead=torch.tensor([0.9]),
        lead_m=torch.tensor([7.0]),
        lead_mps=torch.tensor([3.0]),
        crossing_xy=torch.tensor([[[14.1, 2.0], [20.0, 1.0]]]),
        crossing=torch.tensor([[0.8, 0.1]]),
    )
    found = set(_told(estimate, path()))
    assert Obstacle(7.0, 3.0) in found
    assert Obstacle(13.0, 0.0) in found  # it stops two metres before
    assert [round(o.gap_m, 1) for o in found if o not in (Obstacle(7.0, 3.0), Obstacle(13.0, 0.0))] == [10.0]


def test_it_waits_at_a_red_light_of_a_town_and_goes_on() -> None:
    """40 m of a lane up to its light, which is red when the vehicle comes, and 12 m behind the line."""
    lane, seed = 10, 3
    graph = Traffic(load_town_map("Town02"), seed, 1, 0).lanes
    onward = int(graph.successors[lane, 0])
    before = graph.position(np.full(40, lane), graph.length_m[lane] - 40 + np.arange(40.0))
    route = np.concatenate([before, graph.position(np.full(12, onward), np.arange(12.0))])
    simulator = TownSimulator()
    scenario = TownScenario(
        "Town02", route, seed, lanes=(lane, onward), background_traffic=BackgroundTraffic(0, 0), limit_s=40.0
    )
    drive = drive_route(simulator, scenario, IdmAgent(simulator), route="r")
    assert (drive.score.ending, drive.score.infractions) == (Ending.COMPLETED, ())
    speed_mps = np.array([state.speed_mps for state in drive.states])
    assert speed_mps.max() > 5.0
    first_fast = int(np.flatnonzero(speed_mps > 5.0)[0])
    assert speed_mps[first_fast:].min() < 0.1
    assert speed_mps[-1] > 2.0
