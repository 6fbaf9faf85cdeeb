"""The rule-based agent: what it reads of estimates and boxes, and a drive through a town."""

import numpy as np
import pytest
import torch

from foredrive.data.truth.affordances import PathAhead, path_ahead
from foredrive.driving.drive import drive_route
from foredrive.driving.scores import Ending
from foredrive.driving.speed_rule import waypoints_along
from foredrive.geometry.polylines import arc_lengths
from foredrive.scene import Boxes, Category
from foredrive.scene.affordances import CELLS, TIMES, PathEstimate
from foredrive.scene.boxes import unlabelled
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.scene.traffic_light import LightState
from foredrive.towns.driving.idm_agent import IdmAgent, TruePerception, estimated_view, true_view
from foredrive.towns.driving.town import TownScenario, TownSimulator
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.traffic.lane_graph import LaneControl
from foredrive.towns.traffic.traffic import Traffic

FRONT_M = 4.1


def path(pose: np.ndarray | None = None) -> PathAhead:
    line = np.stack([np.arange(100.0), np.zeros(100), np.zeros(100)], -1)
    return path_ahead(line, arc_lengths(line), 0.0, np.eye(4) if pose is None else pose, FRONT_M)


def test_it_comes_back_to_its_line() -> None:
    pose = np.eye(4)
    pose[1, 3] = 1.0  # a metre to the left
    beside = waypoints_along(path(pose=pose), np.array([0.0, 8.0, 60.0]))
    np.testing.assert_allclose(beside[:, 1], [0.0, -1 + np.exp(-1), -1 + np.exp(-7.5)], atol=1e-6)


def test_what_a_model_estimates_counts_where_it_is_probable() -> None:
    occupied = torch.zeros(TIMES, CELLS)
    occupied[0, 3], occupied[4, 6], occupied[0, 1] = 0.9, 0.8, 0.3
    view = estimated_view(PathEstimate(torch.eye(4)[LightState.RED], torch.tensor(12.0), occupied))
    assert (view.light, view.light_m) == (LightState.RED, 12.0)
    assert view.lead is not None
    assert view.lead.gap_m == 6.5  # a quarter into its cell
    assert view.lead.speed_mps == 3.0  # three cells in two seconds
    assert np.argwhere(view.occupied).tolist() == [[0, 3], [4, 6]]


def test_boxes_go_on_at_constant_velocity() -> None:
    """A cyclist 5 m to the left crosses at 4 m/s; a follower and a car beside are not in the way."""
    boxes = Boxes(
        centre=torch.tensor([[14.1, 5.0, 0.8], [-6.0, 0.0, 0.8], [12.0, -3.5, 0.8]]),
        size_lwh=torch.tensor([[1.8, 0.6, 1.7], [4.0, 1.8, 1.6], [4.0, 1.8, 1.6]]),
        yaw=torch.tensor([-torch.pi / 2, 0.0, 0.0]),
        velocity=torch.tensor([[0.0, -4.0], [8.0, 0.0], [2.0, 0.0]]),
        track_id=torch.arange(3),
        category=torch.tensor([int(Category.BICYCLE), int(Category.CAR), int(Category.CAR)]),
        valid=torch.ones(3, dtype=torch.bool),
        **unlabelled(3),
    )
    view = true_view(boxes, path(), LightState.GREEN, 20.0)
    assert view.lead is None
    # Its ends are at 5 - 4 t ± 0.9: within 1.2 m of the path from 0.73 to 1.78 s, in cells 4 and 5 of 2 m.
    assert np.argwhere(view.occupied).tolist() == [[2, 4], [2, 5], [3, 4], [3, 5]]


def test_it_stops_at_a_stop_sign_of_a_town_and_goes_on() -> None:
    """30 m of a lane up to its sign, and 12 m behind the line."""
    seed, graph = 3, Traffic(load_town_map("Town10HD"), 3, 1, 0).lanes
    onward = int(np.flatnonzero(graph.control == LaneControl.STOP)[0])
    lane = int(graph.predecessors[onward, 0])
    before = graph.position(np.full(30, lane), graph.length_m[lane] - 30 + np.arange(30.0))
    route = np.concatenate([before, graph.position(np.full(12, onward), np.arange(12.0))])
    simulator = TownSimulator()
    scenario = TownScenario(
        "Town10HD",
        route,
        seed,
        lanes=(lane, onward),
        background_traffic=BackgroundTraffic(0, 0),
        limit_s=40.0,
    )
    truth = TruePerception(simulator)
    drive = drive_route(simulator, scenario, IdmAgent(truth.path, truth.view), route="r")
    assert (drive.score.ending, drive.score.infractions) == (Ending.COMPLETED, ())
    speed_mps = np.array([state.speed_mps for state in drive.states])
    first_fast = int(np.flatnonzero(speed_mps > 4.0)[0])
    assert speed_mps[first_fast:].min() < 0.1
    assert speed_mps[-1] > 1.0


@pytest.mark.slow
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
    truth = TruePerception(simulator)
    drive = drive_route(simulator, scenario, IdmAgent(truth.path, truth.view), route="r")
    assert (drive.score.ending, drive.score.infractions) == (Ending.COMPLETED, ())
    speed_mps = np.array([state.speed_mps for state in drive.states])
    assert speed_mps.max() > 5.0
    first_fast = int(np.flatnonzero(speed_mps > 5.0)[0])
    assert speed_mps[first_fast:].min() < 0.1
    assert speed_mps[-1] > 2.0
