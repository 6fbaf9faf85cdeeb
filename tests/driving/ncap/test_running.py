"""Runs of safety tests in a straight log of ten seconds, under all rules; nothing is rendered."""

import dataclasses
import math

import numpy as np
import pytest
import shapely
import torch

from foredrive.driving.drive import DrivePlan, drive_route
from foredrive.driving.ncap.drawing import draw_run
from foredrive.driving.ncap.hd import hd_score_of
from foredrive.driving.ncap.outcome import Outcome, SafetyResult, first_collision, judge
from foredrive.driving.ncap.proposing import propose, propose_kinds
from foredrive.driving.ncap.rules import OURS, PAPER, RELEASED, RULES, Rules
from foredrive.driving.ncap.running import Place, drive_without_action, reference_mps, set_up_run
from foredrive.driving.ncap.scenario import Jitter, Rectilinear, SafetyScenario, ScenarioActor
from foredrive.driving.ncap.self_test import run_reference, self_test
from foredrive.driving.replay.threats import Threat
from foredrive.driving.simple_agents import StraightAgent
from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw
from foredrive.methods.reconstruction.renderer import ReconstructedRenderer
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks, joined_tracks, states_at
from foredrive.methods.reconstruction.vehicle import LoggedVehicle
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.content import GaussianContent
from foredrive.methods.splatad.scene import GaussianScene
from foredrive.scene import CameraRig, Category

SPEED_MPS, END_S, YAW = 8.0, 10.0, 0.6
ORIGIN = np.array([300.0, -40.0, 5.0])
AHEAD, LEFT = np.array([math.cos(YAW), math.sin(YAW), 0.0]), np.array([-math.sin(YAW), math.cos(YAW), 0.0])


def at(ahead_m: float, left_m: float = 0.0) -> tuple[float, float, float]:
    x, y, z = (ORIGIN + ahead_m * AHEAD + left_m * LEFT).tolist()
    return x, y, z


def place(category: Category = Category.CAR, parked_m: tuple[float, float] = (-50.0, 3.0)) -> Place:
    """8 m/s straight on in the direction `YAW`, with one car parked that far ahead and left of the start."""
    t_s = torch.arange(0.0, END_S + 1e-6, 0.1)
    zero = torch.zeros_like(t_s)
    T_world_scene = matrix_from_yaw(torch.tensor(YAW), torch.from_numpy(ORIGIN).float()).double()
    parked = matrix_from_yaw(zero, torch.stack([zero + parked_m[0], zero + parked_m[1], zero + 0.8], dim=-1))
    tracks = ActorTracks(
        torch.tensor([4]),
        torch.tensor([int(category)]),
        torch.tensor([[4.0, 1.8, 1.6]]),
        t_s,
        parked[None],
        torch.ones(1, len(t_s), dtype=torch.bool),
    )
    rig = CameraRig(torch.zeros(0, 3, 3), torch.zeros(0, 4, 4), torch.zeros(0, 5), torch.zeros(0), (), (4, 4))
    poses = matrix_from_yaw(zero, torch.stack([SPEED_MPS * t_s, zero, zero], dim=-1))
    vehicle = LoggedVehicle(t_s, poses, T_world_scene, rig, None, None, math.inf)
    one = Gaussians(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3), torch.zeros(1), torch.ones(1, 5)
    )
    graph = SceneGraph(tracks, GaussianContent(one, torch.zeros(1, dtype=torch.int64)))
    return Place(
        graph,
        vehicle,
        lambda changed: ReconstructedRenderer(GaussianScene(graph, cameras=1), changed, vehicle),
        {"0101": 4},
    )


def scenario(way: Rectilinear, kind: Threat, jitter: Jitter | None = None) -> SafetyScenario:
    """From 1 s to 9 s of the log, of which the vehicle drives the last 7 s itself."""
    actor = ScenarioActor(("0101",), way, yaw_rad=YAW + 0.3, jitter=jitter or Jitter())
    return SafetyScenario("0001", kind, "log", 2, 8.0, (actor,), priming_frames=2)


STANDING = scenario(Rectilinear(at(50.0), 0.0, YAW), Threat.STATIONARY)
FRONTAL = scenario(Rectilinear(at(55.0), 5.0, YAW + math.pi, 4.0), Threat.FRONTAL)
SIDE = scenario(Rectilinear(at(45.0), 5.0, YAW + 0.5 * math.pi, 5.0), Threat.SIDE)


@pytest.mark.parametrize("rules", list(RULES.values()), ids=list(RULES))
@pytest.mark.parametrize(
    ("test", "impact_mps"),
    [(STANDING, 8.0), (FRONTAL, 12.0), (SIDE, math.hypot(8.0, 5.0))],
    ids=lambda value: value.label if isinstance(value, SafetyScenario) else "",
)
def test_who_takes_no_action_hits_at_the_speed_of_both(
    test: SafetyScenario, impact_mps: float, rules: Rules
) -> None:
    here = place()
    hit_mps = drive_without_action(here, test, 0, rules)
    assert hit_mps == pytest.approx(impact_mps, rel=0.03)
    drive = set_up_run(here, test, 0, rules, sensors=False, past_frames=1).simulator.drive
    assert reference_mps(rules, drive, draw_run(test, 0), hit_mps) == pytest.approx(impact_mps, rel=0.03)


def judged(test: SafetyScenario, rules: Rules, speed_mps: float) -> SafetyResult:
    run = set_up_run(place(), test, 0, rules, sensors=False, past_frames=1)
    drive = drive_route(
        run.simulator, run.scenario, StraightAgent(speed_mps), route=test.label, pilot=run.pilot
    )
    assert drive.error == ""
    return judge(test.kind, drive, SPEED_MPS, rules.left_way_score)


@pytest.mark.parametrize("rules", list(RULES.values()), ids=list(RULES))
def test_who_brakes_at_once_is_not_hit_but_makes_no_progress(rules: Rules) -> None:
    """The run begins at 2 s, 16 m on, and the log drives 56 m in the 7 s."""
    result = judged(STANDING, rules, 0.0)
    assert (result.outcome, result.score) == (Outcome.STOPPED_SHORT, 5.0)
    assert 0.05 < result.progress < 0.45


def test_the_actor_stands_where_and_as_it_was_drawn() -> None:
    test = dataclasses.replace(STANDING, actors=(dataclasses.replace(STANDING.actors[0], flipped=("0101",)),))
    here = place()
    run = set_up_run(here, test, 0, PAPER, sensors=False, past_frames=1)
    states = states_at(run.simulator._tracks, 4.05)
    T_scene_actor = states.T_scene_actor[1]  # after the log's parked car
    T = here.vehicle.T_world_scene @ T_scene_actor.double()
    assert np.allclose(T[:3, 3], np.add(at(50.0), [0.0, 0.0, 0.8]), atol=1e-4)
    yaw = math.atan2(T[1, 0], T[0, 0])
    assert math.remainder(yaw - (YAW + 0.3 + math.pi), 2 * math.pi) == pytest.approx(0.0, abs=1e-5)
    ours = set_up_run(here, test, 0, OURS, sensors=False, past_frames=1)
    assert ours.simulator._tracks.track_id.tolist() == [4, 5]


def test_a_moving_actor_heads_where_it_moves() -> None:
    here = place()
    run = set_up_run(here, SIDE, 0, PAPER, sensors=False, past_frames=1)
    states = states_at(run.simulator._tracks, 6.0)
    T = here.vehicle.T_world_scene @ states.T_scene_actor[1].double()
    assert np.allclose(T[:2, 3], at(45.0, 5.0)[:2], atol=1e-3)
    assert math.atan2(T[1, 0], T[0, 0]) == pytest.approx(YAW + 0.5 * math.pi, abs=1e-4)
    inverse = inverse_se3(here.vehicle.T_world_scene)
    velocity = inverse[:3, :3].T @ states.velocity_mps[1].double()
    assert np.allclose(velocity[:2], 5.0 * LEFT[:2], atol=1e-3)


@pytest.mark.parametrize(
    ("rules", "present"), [(OURS, [4, 5, 6, 7]), (PAPER, [4, 6, 7]), (RELEASED, [4, 6, 7])], ids=lambda x: ""
)
def test_only_what_moves_vanishes_for_a_test_of_the_paper(rules: Rules, present: list[int]) -> None:
    """In the log 4 is parked and an actor, 5 drives, and 6 is parked and an obstacle. 7 is the test's own."""
    here = place()
    four = here.graph.tracks
    driving = four.T_scene_actor.clone()
    driving[0, :, 1, 3] += 10.0 + 2.0 * four.t_s
    five = dataclasses.replace(four, track_id=torch.tensor([5]), T_scene_actor=driving)
    six = dataclasses.replace(four, track_id=torch.tensor([6]))
    here = dataclasses.replace(
        here, graph=dataclasses.replace(here.graph, tracks=joined_tracks(four, five), obstacles=six)
    )
    run = set_up_run(here, STANDING, 0, rules, sensors=False, past_frames=1)
    assert sorted(run.simulator.tracks.track_id.tolist()) == present


@pytest.mark.parametrize("rules", list(RULES.values()), ids=list(RULES))
def test_a_parked_vehicle_is_hit_under_all_rules(rules: Rules) -> None:
    """It stands 30 m on, 20 m in front of the test's own actor."""
    parked = place(parked_m=(30.0, 0.0))
    graph, nothing = parked.graph, torch.tensor([False])
    as_obstacle = dataclasses.replace(
        parked, graph=dataclasses.replace(graph, tracks=graph.tracks.only(nothing), obstacles=graph.tracks)
    )
    assert drive_without_action(parked, STANDING, 0, rules) == pytest.approx(8.0, rel=0.03)
    run = set_up_run(parked, STANDING, 0, rules, sensors=False, past_frames=1)
    drive = drive_route(run.simulator, run.scenario, StraightAgent(8.0), route="", pilot=run.pilot)
    hit = first_collision(drive)
    assert hit is not None
    front_m = 30.0 - 2.0 - rules.vehicle.axle_to_centre_m - 0.5 * rules.vehicle.length_m
    assert hit.t_s == pytest.approx((front_m - 16.0) / 8.0, abs=0.3)
    with pytest.raises(InputError, match="4 is no actor of its own"):
        set_up_run(as_obstacle, STANDING, 0, rules, sensors=False, past_frames=1)


def test_pedestrians_count_under_our_rules_alone() -> None:
    here = place(Category.PEDESTRIAN)
    assert drive_without_action(here, STANDING, 0, OURS) == pytest.approx(8.0, rel=0.03)
    assert drive_without_action(here, STANDING, 0, RELEASED) is None


def test_the_end_of_the_log_is_the_reference_of_the_released_code() -> None:
    """The log brakes from 8 to 2 m/s in its last second; 4 s after the start it drives 8 m/s."""
    here = place()
    t_s, poses = here.vehicle.t_s, here.vehicle.T_scene_ego.clone()
    late = (t_s - 9.0).clamp(min=0.0)
    poses[:, 0, 3] -= 6.0 * late
    vehicle = dataclasses.replace(here.vehicle, T_scene_ego=poses)
    slowed = dataclasses.replace(here, vehicle=vehicle)
    drive = set_up_run(slowed, STANDING, 0, PAPER, sensors=False, past_frames=1).simulator.drive
    drawn = draw_run(STANDING, 0)
    assert reference_mps(PAPER, drive, drawn, 1.0) == pytest.approx(8.0, abs=0.05)
    assert reference_mps(RELEASED, drive, drawn, 1.0) == pytest.approx(2.0, abs=0.05)
    assert reference_mps(OURS, drive, drawn, 7.5) == 7.5


def test_scenarios_that_nobody_hits_are_named_and_left_out() -> None:
    aside = dataclasses.replace(
        scenario(Rectilinear(at(50.0, 12.0), 0.0, YAW), Threat.STATIONARY), name="aside"
    )
    long = dataclasses.replace(STANDING, name="long", length_s=20.0)
    nobody = dataclasses.replace(
        STANDING, name="nobody", actors=(dataclasses.replace(STANDING.actors[0], names=("0102",)),)
    )
    elsewhere = dataclasses.replace(STANDING, name="elsewhere", scene="0102")
    here = place()

    def place_of(test: SafetyScenario) -> Place:
        if test.scene != "log":
            raise InputError("there is no such scene")
        return here

    tested = self_test([aside, STANDING, long, nobody, elsewhere], place_of, 2, OURS)
    assert tested.passed == (STANDING,)
    references = [run_reference(here, STANDING, number, OURS) for number in range(2)]
    assert references == pytest.approx([8.0, 8.0], rel=0.03)
    assert set(tested.left_out) == {f"stationary-{name}" for name in ("aside", "long", "nobody", "elsewhere")}
    assert "run 0 passes without any action" in tested.reasons
    assert "the log ends at 10.0 s" in tested.reasons
    assert "no actor '0102'; some of those that it has: 0101" in tested.reasons


def test_the_run_of_a_number_is_the_same_for_every_agent() -> None:
    shaken = scenario(
        Rectilinear(at(50.0), 0.0, YAW), Threat.STATIONARY, Jitter(YAW, longitudinal_m=4.0, lateral_m=0.5)
    )
    here = place()
    runs = [set_up_run(here, shaken, number, OURS, sensors=False, past_frames=1) for number in (3, 3, 4)]
    poses = [run.simulator._tracks.T_scene_actor[-1, 0] for run in runs]
    assert torch.equal(poses[0], poses[1])
    assert not torch.equal(poses[0], poses[2])


def test_every_kind_is_proposed_where_the_way_is_free() -> None:
    here = place(parked_m=(10.0, 8.0))
    found = propose(here, "log")
    assert {scenario.kind for scenario in found} == set(Threat)
    first = found[: len(Threat)]
    assert all(scenario.start_frame == 1 and scenario.length_s == 8.0 for scenario in first)
    assert all(actor.names == ("0101",) for scenario in found for actor in scenario.actors)
    assert max(0.5 * scenario.start_frame + scenario.length_s for scenario in found) <= END_S
    tested = self_test(first, lambda scenario: here, 1, OURS)
    assert tested.passed == tuple(first)


def test_a_kind_that_is_feasible_nowhere_is_tried_nearer_and_slower() -> None:
    """A wall 14 m to the right: from behind it, 20 m away, nobody crosses; from 9 m away somebody does."""
    here = place(parked_m=(10.0, -14.0))
    wall = dataclasses.replace(here.graph.tracks, size_lwh=torch.tensor([[300.0, 1.8, 1.6]]))
    here = dataclasses.replace(here, graph=dataclasses.replace(here.graph, tracks=wall))
    assert {scenario.kind for scenario in propose(here, "log")} == {Threat.STATIONARY, Threat.FRONTAL}
    found = propose_kinds(here, "log")
    assert [scenario for scenario in found if scenario.kind is not Threat.SIDE] == propose(here, "log")
    ways = [scenario.actors[0].way for scenario in found if scenario.kind is Threat.SIDE]
    assert {way.speed_mps for way in ways if isinstance(way, Rectilinear)} == {3.0}
    assert len({scenario.label for scenario in found}) == len(found)
    free = place(parked_m=(10.0, 8.0))
    assert propose_kinds(free, "log") == propose(free, "log")


def test_proposals_read_boxes_that_the_reconstruction_has_refined() -> None:
    """Refined boxes are parameters, which still have a gradient."""
    here = place(parked_m=(10.0, 8.0))
    refined = here.graph.tracks.T_scene_actor.clone().requires_grad_()
    tracks = dataclasses.replace(here.graph.tracks, T_scene_actor=refined)
    there = dataclasses.replace(here, graph=dataclasses.replace(here.graph, tracks=tracks))
    assert propose(there, "log") == propose(here, "log")


def test_nothing_is_proposed_where_something_stands_in_the_way() -> None:
    assert propose(place(parked_m=(45.0, 0.0)), "log") == []
    with pytest.raises(InputError, match="no car that is an actor of its own was seen"):
        propose(place(), "log")


def test_the_hd_score_of_a_drive_tells_who_plans_through_others() -> None:
    """At 8 m/s towards a car that stands on the path, or far beside it."""
    corners = [at(-20.0, -4.0), at(150.0, -4.0), at(150.0, 4.0), at(-20.0, 4.0)]
    street, found = shapely.Polygon([corner[:2] for corner in corners]), {}
    aside = scenario(Rectilinear(at(50.0, 12.0), 0.0, YAW), Threat.STATIONARY)
    for name, test in (("on", STANDING), ("beside", aside)):
        here = place()
        run = set_up_run(here, test, 0, OURS, sensors=False, past_frames=0)
        agent = StraightAgent(SPEED_MPS)
        drive = drive_route(run.simulator, run.scenario, agent, route=name, pilot=run.pilot)
        assert len(drive.plans) == len(drive.act_s)
        tracks, T = run.simulator.tracks, here.vehicle.T_world_scene
        found[name] = hd_score_of(drive, tracks, T, run.scenario.start_s, street)
    on, beside = found["on"], found["beside"]
    assert on is not None
    assert beside is not None
    assert (beside.nc, beside.dac, beside.ttc, beside.comfort) == (1.0, 1.0, 1.0, 1.0)
    assert beside.hd_score == pytest.approx(beside.completion)
    assert on.nc < 0.9
    assert on.hd_score < 0.7 * beside.hd_score


@pytest.mark.parametrize(
    ("category", "nc"),
    [(Category.CAR, 0.5), (Category.TRUCK, 0.5), (Category.BICYCLE, 0.5), (Category.PEDESTRIAN, 1.0)],
)
def test_all_vehicles_count_in_the_hd_score(category: Category, nc: float) -> None:
    """One plan ends 20 m on, another one 32 m on and so in what stands 36 m on: its rear is at 34 m.

    The middle is 1.65 m in front of the rear axle, and half of the vehicle's length 2.45 m.
    """
    here = place(category, parked_m=(16.0 + 36.0, 0.0))
    run = set_up_run(here, FRONTAL, 0, OURS, sensors=False, past_frames=0)
    drive = drive_route(run.simulator, run.scenario, StraightAgent(SPEED_MPS), route="r", pilot=run.pilot)
    ahead_m = np.linspace(0.0, 1.0, 7)[1:, None] * np.array([[1.0, 0.0]])
    both = dataclasses.replace(
        drive, plans=(DrivePlan(0, 20.0 * ahead_m, None), DrivePlan(0, 32.0 * ahead_m, None))
    )
    street = shapely.Polygon([at(*corner)[:2] for corner in ((-20, -9), (150, -9), (150, 9), (-20, 9))])
    found = hd_score_of(both, here.graph.tracks, here.vehicle.T_world_scene, run.scenario.start_s, street)
    assert found is not None
    assert found.nc == nc


def test_a_plan_that_stops_in_a_curve_keeps_its_heading() -> None:
    """It turns by 0.4 rad/s and brakes by 3.2 m/s². To turn back within one step would be uncomfortable."""
    here = place()
    run = set_up_run(here, STANDING, 0, OURS, sensors=False, past_frames=0)
    drive = drive_route(run.simulator, run.scenario, StraightAgent(SPEED_MPS), route="r", pilot=run.pilot)
    ways, turns = np.array([2.0, 1.2, 0.4, 0.0, 0.0, 0.0]), np.array([0.15, 0.35, 0.55, 0.0, 0.0, 0.0])
    points = np.cumsum(ways[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1), axis=0)
    street = shapely.Polygon([at(*corner)[:2] for corner in ((-20, -9), (150, -9), (150, 9), (-20, 9))])
    curved = dataclasses.replace(drive, plans=(DrivePlan(0, points, None),))
    tracks, T = run.simulator.tracks, here.vehicle.T_world_scene
    found = hd_score_of(curved, tracks, T, run.scenario.start_s, street)
    assert found is not None
    assert (found.comfort, found.dac) == (1.0, 1.0)
