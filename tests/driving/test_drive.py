"""A drive from its start to its end: who fails is counted, who is late is late, and the expert arrives."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from small_drives import one_example

from foredrive.data.batches import stack_records
from foredrive.driving.drive import Drive, PlanningTiming, drive_route
from foredrive.driving.drive_record import record_of
from foredrive.driving.dynamics import STEP_S
from foredrive.driving.faults import NO_FAULTS
from foredrive.driving.faulty_agent import FaultyAgent
from foredrive.driving.scores import Ending
from foredrive.driving.simple_agents import StraightAgent
from foredrive.errors import InputError
from foredrive.scene import Clip, Trajectory
from foredrive.scene.affordances import CELLS, TIMES, PathEstimate
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.scene.traffic_light import LightState
from foredrive.towns.driving.town import TownScenario, TownSimulator
from foredrive.towns.driving.town_expert import TownExpert
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.traffic.traffic import Traffic

SEED = 3


@pytest.fixture(scope="module")
def scenario() -> TownScenario:
    """45 m along the longest lane of Town02 outside of junctions."""
    graph = Traffic(load_town_map("Town02"), SEED, 1, 0).lanes
    lane = int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))
    route = graph.position(np.full(45, lane), 20.0 + np.arange(45))
    return TownScenario(
        "Town02", route, SEED, lanes=(lane,), background_traffic=BackgroundTraffic(6, 4), limit_s=40.0
    )


@pytest.fixture(scope="module")
def simulator() -> TownSimulator:
    return TownSimulator()


def test_going_straight_keeps_a_speed_and_raises_one_below_its_own() -> None:
    """A batch of two: one at walking speed, which is no speed to keep, and one that is faster."""
    clips = stack_records([one_example(seed).clip.observed()[0] for seed in (1, 2)])
    speed_mps = clips.ego_speed_mps.clone()
    speed_mps[:, -1] = torch.tensor([1.5, 12.0])
    clips = dataclasses.replace(clips, ego_speed_mps=speed_mps)
    points = torch.arange(1, 7) * 0.5
    keeping, constant = (StraightAgent(5.0, keeps).act(clips).xy[:, 0] for keeps in (True, False))
    torch.testing.assert_close(keeping[..., 0], torch.stack([5.0 * points, 12.0 * points]))
    torch.testing.assert_close(constant[..., 0], torch.stack([5.0 * points, 5.0 * points]))
    assert not keeping[..., 1].any()


class Failing:
    """Drives straight on, and raises an error or plans nonsense at its fifth plan."""

    def __init__(self, nonsense: bool) -> None:
        self._plans, self._nonsense = 0, nonsense

    def act(self, observation: Clip) -> Trajectory:
        self._plans += 1
        plan = StraightAgent(4.0).act(observation)
        if self._plans < 5:
            return plan
        if self._nonsense:
            return dataclasses.replace(plan, xy=torch.full_like(plan.xy, math.nan))
        raise RuntimeError("out of ideas")


@pytest.mark.parametrize(("nonsense", "told"), [(False, "RuntimeError: out of ideas"), (True, "finite")])
def test_an_agent_that_fails_ends_the_drive_and_is_scored_by_what_it_drove(
    simulator: TownSimulator, scenario: TownScenario, nonsense: bool, told: str
) -> None:
    drive = drive_route(simulator, scenario, Failing(nonsense), route="r")
    assert drive.score.ending is Ending.CRASHED
    assert drive.score.failed
    assert told in drive.error
    assert drive.score.duration_s == pytest.approx(4 * 0.5)
    driven_m = drive.states[-1].x_m - drive.states[0].x_m, drive.states[-1].y_m - drive.states[0].y_m
    assert drive.score.driven_m == pytest.approx(math.hypot(*driven_m), abs=0.05)
    assert 0.02 < drive.score.completion < 0.25
    assert drive.score.driving_score_1_0 == pytest.approx(100 * drive.score.completion)


def test_a_plan_takes_effect_after_its_latency(simulator: TownSimulator, scenario: TownScenario) -> None:
    brief = dataclasses.replace(scenario, limit_s=1.4)
    moves = {}
    for latency_s in (0.0, 0.6):
        drive = drive_route(
            simulator, brief, StraightAgent(4.0), route="r", pace=PlanningTiming(latency_s=latency_s)
        )
        moves[latency_s] = next(k for k, state in enumerate(drive.states) if state.speed_mps > 0)
        assert drive.score.ending is Ending.TIMEOUT
        assert len(drive.act_s) == 3
    assert moves[0.6] - moves[0.0] == round(0.6 / STEP_S)


class Telling:
    """Drives straight on, and sees a green light 12 m ahead and somebody in the third cell."""

    def __init__(self) -> None:
        self.sight: PathEstimate | None = None

    def act(self, observation: Clip) -> Trajectory:
        occupied = torch.zeros(1, TIMES, CELLS)
        occupied[0, 0, 2], occupied[0, 1, 5] = 0.9, 1.0  # the second one only later
        light = torch.tensor([[0.1, 0.1, 0.1, 0.7]])
        self.sight = PathEstimate(light, torch.full((1,), 12.0), occupied)
        return StraightAgent(4.0).act(observation)


def test_a_record_keeps_plans_in_the_world_and_what_was_seen(
    simulator: TownSimulator, scenario: TownScenario
) -> None:
    brief = dataclasses.replace(scenario, limit_s=1.4)
    faulty = FaultyAgent(Telling(), NO_FAULTS, 0.5, "d")
    for agent, tells in ((Telling(), True), (faulty, True), (StraightAgent(4.0), False)):
        drive = drive_route(simulator, brief, agent, route="r")
        record = record_of(drive, scenario.route_xyz, 45.0, town="Town02", log="logs/d", wall_s=1.0)
        assert [plan.t_s for plan in record.plans] == [0.0, 0.5, 1.0]
        for plan in record.plans:
            state = drive.states[round(plan.t_s / STEP_S)]
            ahead = np.array([math.cos(state.yaw_rad), math.sin(state.yaw_rad)])
            wanted = np.array([state.x_m, state.y_m]) + np.outer([0.0, 2.0, 4.0], ahead)
            np.testing.assert_allclose(plan.xy[:3], wanted, atol=0.006)
            assert (plan.light, plan.light_m) == ((LightState.GREEN, 12.0) if tells else (None, 0.0))
            assert np.flatnonzero(plan.occupied).tolist() == ([2] if tells else [])
        assert abs(drive.states[0].yaw_rad) > 0.1  # the world's axes are not the vehicle's


def test_who_plans_less_often_is_asked_less_often(simulator: TownSimulator, scenario: TownScenario) -> None:
    brief = dataclasses.replace(scenario, limit_s=1.9)
    frames: list[float] = []

    def on_frame() -> None:
        frames.append(simulator.state.t_s)

    pace = PlanningTiming(period_s=1.0)
    drive = drive_route(simulator, brief, StraightAgent(0.0), route="r", pace=pace, on_frame=on_frame)
    assert len(drive.act_s) == 2
    assert frames == [0.0, 0.5, 1.0, 1.5]
    assert drive.score.completion == pytest.approx(0.0, abs=0.02)
    for wrong in ({"period_s": 0.3}, {"period_s": 0.0}, {"latency_s": -0.1}, {"latency_s": math.nan}):
        with pytest.raises(InputError):
            PlanningTiming(**wrong)


def test_the_expert_arrives_and_drives_the_same_again(
    simulator: TownSimulator, scenario: TownScenario
) -> None:
    def drive(limit_s: float) -> Drive:
        limited = dataclasses.replace(scenario, limit_s=limit_s)
        return drive_route(simulator, limited, TownExpert(simulator), route="r")

    first = drive(40.0)
    assert first.score.ending is Ending.COMPLETED
    assert first.score.driving_score_1_0 == first.score.driving_score_2_1 == 100.0
    assert first.comfort is not None
    assert first.comfort.comfortable
    assert min(first.nearest_s) > 0.95
    again = drive(4.0)
    assert again.states == first.states[: len(again.states)]
