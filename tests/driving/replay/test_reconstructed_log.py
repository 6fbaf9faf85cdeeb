"""Drives in a log of ten seconds whose actors replay; nothing is rendered."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from foredrive.driving.drive import Drive, drive_route
from foredrive.driving.dynamics import EGO
from foredrive.driving.ncap.outcome import Outcome, judge, threat_score
from foredrive.driving.observation import no_images
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.replay.logged_lanes import LoggedLanes
from foredrive.driving.replay.reconstructed import STRUCK, ReconstructedScenario, ReconstructedSimulator
from foredrive.driving.replay.threats import (
    AFTER_S,
    AS_PLANNED,
    Threat,
    Variation,
    reference_mps,
    send_threat,
)
from foredrive.driving.scores import Ending
from foredrive.driving.simple_agents import ReplayAgent, StraightAgent
from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw
from foredrive.methods.reconstruction.edits import Edit, ShiftEgo, apply_edits
from foredrive.methods.reconstruction.renderer import ReconstructedRenderer
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.vehicle import LoggedVehicle
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.content import GaussianContent
from foredrive.methods.splatad.scene import GaussianScene
from foredrive.scene import Agent, BicycleState, CameraRig, Category, Rendered

SPEED_MPS, PERIOD_S, END_S = 8.0, 0.1, 10.0
WORLD_YAW = 0.7
SLOPE = 0.1


def actor(x_m: float, speed_mps: float, category: Category = Category.CAR, track_id: int = 3) -> ActorTracks:
    """Somebody on the line that the log drives along, as seen at its start."""
    t_s = torch.arange(0.0, END_S + 1e-6, PERIOD_S)
    xyz = torch.stack([x_m + speed_mps * t_s, torch.zeros_like(t_s), torch.full_like(t_s, 0.8)], dim=-1)
    return ActorTracks(
        track_id=torch.tensor([track_id]),
        category=torch.tensor([int(category)]),
        size_lwh=torch.tensor([[4.0, 1.8, 1.6]]),
        t_s=t_s,
        T_scene_actor=matrix_from_yaw(torch.zeros_like(t_s), xyz)[None],
        present=torch.ones(1, len(t_s), dtype=torch.bool),
    )


def vehicle() -> LoggedVehicle:
    """Straight on and uphill in its world; the scene's frame is the first ego frame."""
    t_s = torch.arange(0.0, END_S + 1e-6, PERIOD_S)
    way = torch.stack([SPEED_MPS * t_s, torch.zeros_like(t_s), torch.zeros_like(t_s)], dim=-1)
    T_world_scene = torch.eye(4, dtype=torch.float64)
    turn = Rotation.from_euler("ZY", [WORLD_YAW, -math.atan(SLOPE)]).as_matrix()
    T_world_scene[:3, :3] = torch.from_numpy(turn)
    T_world_scene[:3, 3] = torch.tensor([500.0, -30.0, 12.0])
    rig = CameraRig(torch.zeros(0, 3, 3), torch.zeros(0, 4, 4), torch.zeros(0, 5), torch.zeros(0), (), (4, 4))
    poses = matrix_from_yaw(torch.zeros_like(t_s), way)
    return LoggedVehicle(t_s, poses, T_world_scene, rig, None, None, math.inf)


def scene_with(tracks: ActorTracks) -> SceneGraph:
    """One Gaussian on the actor."""
    one = Gaussians(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3), torch.zeros(1), torch.ones(1, 5)
    )
    return SceneGraph(tracks, GaussianContent(one, torch.zeros(1, dtype=torch.int64)))


def begun(graph: SceneGraph, edits: tuple[Edit, ...] = (), start_s: float = 1.0) -> ReconstructedSimulator:
    edited = apply_edits(graph, edits)
    drive = LoggedDrive(vehicle(), edited.T_ego_shifted)
    renderer = ReconstructedRenderer(GaussianScene(graph, cameras=1), edited.graph, vehicle())
    simulator = ReconstructedSimulator(renderer, edited.graph.tracks, drive)
    simulator.reset(ReconstructedScenario(start_s, sensors=False))
    return simulator


def driven(simulator: ReconstructedSimulator, agent: Agent) -> Drive:
    return drive_route(simulator, simulator.scenario, agent, route="log")


def replay(simulator: ReconstructedSimulator) -> ReplayAgent:
    return ReplayAgent(simulator.drive, lambda: simulator.scenario.start_s + simulator.state.t_s)


FAR = actor(200.0, SPEED_MPS)


@pytest.mark.parametrize("at_s", [0.0, 0.23, 5.0, 9.9, 10.0])
@pytest.mark.parametrize("acceleration_mps2", [-1.5, 0.0, 2.0])
def test_the_state_of_a_log_has_its_acceleration(acceleration_mps2: float, at_s: float) -> None:
    """20 m/s at the start, and a constant acceleration: x = 20 t + a t² / 2."""
    t_s = torch.arange(0.0, END_S + 1e-6, PERIOD_S)
    way = 20.0 * t_s + 0.5 * acceleration_mps2 * t_s**2
    poses = matrix_from_yaw(0 * t_s, torch.stack([way, 0 * way, 0 * way], dim=-1))
    drive = LoggedDrive(dataclasses.replace(vehicle(), T_scene_ego=poses), torch.eye(4))
    state, level = drive.state_at(at_s), 1 / math.hypot(1.0, SLOPE)  # speeds are those in the plane
    assert state.acceleration_mps2 == pytest.approx(level * acceleration_mps2, abs=0.02)
    speed_mps = level * (20.0 + acceleration_mps2 * at_s)
    assert state.speed_mps == pytest.approx(speed_mps, abs=0.21)  # at the ends one-sided


def test_a_log_of_half_a_second_tells_no_acceleration() -> None:
    short = dataclasses.replace(vehicle(), t_s=vehicle().t_s[:6], T_scene_ego=vehicle().T_scene_ego[:6])
    assert LoggedDrive(short, torch.eye(4)).state_at(0.2).acceleration_mps2 == 0.0


def test_who_goes_on_as_the_log_did_drives_all_of_it() -> None:
    simulator = begun(scene_with(FAR))
    drive = driven(simulator, replay(simulator))
    assert drive.error == ""
    assert drive.score.ending is Ending.COMPLETED
    assert drive.score.infractions == ()
    assert drive.score.driven_m == pytest.approx(SPEED_MPS * drive.score.duration_s, abs=1.0)
    for k, state in enumerate(drive.states):
        logged = simulator.drive.pose_at(1.0 + 0.05 * k)[:2, 3]
        assert np.hypot(*(logged - [state.x_m, state.y_m])) < 0.3


def test_the_vehicle_stands_on_the_slope_and_sees_boxes_from_there() -> None:
    simulator = begun(scene_with(FAR))
    T = simulator.state.frames[-1].T_world_ego
    assert T[2, 2] == pytest.approx(1 / math.hypot(1, SLOPE))
    begin = simulator.drive.pose_at(1.0)
    assert np.allclose(T, begin, atol=1e-5)
    x_m, y_m = begin[:2, 3] + 2.0 * np.array([-math.sin(WORLD_YAW), math.cos(WORLD_YAW)])
    aside = BicycleState(float(x_m), float(y_m), WORLD_YAW, 0.0)
    beside = np.linalg.inv(begin) @ simulator.drive.on_ground(aside)
    assert np.allclose(beside[:3, 3], [0, 2, 0], atol=1e-5)
    ahead_m = 0.3 * np.array([math.cos(WORLD_YAW), math.sin(WORLD_YAW)])  # of the nearest pose, uphill
    further = BicycleState(*(begin[:2, 3] + ahead_m).tolist(), WORLD_YAW, 0.0)
    assert simulator.drive.on_ground(further)[2, 3] == pytest.approx(begin[2, 3] + 0.3 * SLOPE, abs=1e-5)
    near = begun(scene_with(actor(30.0, 0.0)))
    boxes = near.state.frames[-1].boxes
    assert torch.allclose(boxes.centre, torch.tensor([[30.0 - SPEED_MPS, 0.0, 0.8]]), atol=1e-4)
    assert float(boxes.yaw) == pytest.approx(0.0, abs=1e-5)
    past, now = near.state.frames
    assert (past.t_s, now.t_s) == (-0.5, 0.0)
    assert float(past.boxes.centre[0, 0]) == pytest.approx(30 - 0.5 * SPEED_MPS, abs=1e-4)


def test_a_slower_vehicle_ahead_is_run_into_at_the_difference() -> None:
    """Its rear is 20 m before the bumper, which at 5 m/s more takes 4 s."""
    bumper_m = EGO.axle_to_centre_m + 0.5 * EGO.length_m
    graph = scene_with(actor(bumper_m + 20.0 + 2.0 + 5.0, SPEED_MPS - 5.0))
    simulator = begun(graph)
    drive = driven(simulator, replay(simulator))
    (hit,) = drive.score.infractions
    assert hit.kind == "collision_vehicle"
    assert hit.severity == pytest.approx(5.0, abs=0.3)
    assert hit.t_s == pytest.approx(4.0, abs=0.2)


def test_who_drives_into_the_vehicle_from_behind_is_not_its_fault() -> None:
    simulator = begun(scene_with(actor(-15.0, SPEED_MPS)))
    drive = driven(simulator, StraightAgent(0.0))
    assert drive.score.infractions == ()
    assert [event.kind for event in drive.events if "car" in event.detail] == [STRUCK]
    assert drive.score.ending is Ending.TIMEOUT  # the log was over
    assert drive.score.duration_s == pytest.approx(END_S - 1.0, abs=0.06)
    assert 0 < drive.score.completion < 0.4


def test_leaving_what_the_log_has_seen_ends_the_drive() -> None:
    simulator = begun(scene_with(FAR))

    @dataclasses.dataclass
    class Veering:
        def act(self, observation):  # type: ignore[no-untyped-def]
            plan = StraightAgent(SPEED_MPS).act(observation)
            return dataclasses.replace(
                plan, xy=plan.xy + torch.tensor([0.0, 1.0]) * plan.xy[..., :1] ** 2 / 60
            )

    drive = driven(simulator, Veering())
    assert drive.score.ending is Ending.DEVIATION
    assert drive.score.completion < 1


def test_the_way_outside_of_lanes_is_counted() -> None:
    """The lane ends 40 m on from the log's start, beside the vehicle's middle and 1.3 m more."""
    x_m = np.array([-5.0, 40.0, 40.0, -5.0])
    y_m = np.array([2.0, 2.0, -2.0, -2.0])
    T = vehicle().T_world_scene.numpy()
    outline = (T[:3, :2] @ np.stack([x_m, y_m])).T[:, :2] + T[:2, 3]
    drive = LoggedDrive(vehicle(), torch.eye(4))
    renderer = ReconstructedRenderer(GaussianScene(scene_with(FAR), cameras=1), scene_with(FAR), vehicle())
    simulator = ReconstructedSimulator(renderer, FAR, drive, LoggedLanes([outline]))
    simulator.reset(ReconstructedScenario(1.0, sensors=False))
    score = driven(simulator, replay(simulator)).score
    inside_m = 40.0 + 1.3 - EGO.axle_to_centre_m - SPEED_MPS  # it begins 8 m on
    assert score.outside_lanes == pytest.approx(1 - inside_m / score.driven_m, abs=0.02)
    assert begun(scene_with(FAR)).progress().outside_lanes == 0.0


@pytest.mark.parametrize("start_s", [0.2, END_S, 99.0])
def test_a_drive_begins_within_the_log(start_s: float) -> None:
    with pytest.raises(InputError, match=r"can begin at 0\.5 to 10\.0 s"):
        begun(scene_with(FAR), start_s=start_s)


def test_a_log_that_hardly_moves_is_no_route() -> None:
    with pytest.raises(InputError, match="m long"):
        begun(scene_with(FAR), start_s=END_S - 0.3)


@pytest.mark.parametrize("threat", list(Threat))
def test_a_threat_hits_who_goes_on_as_the_log_did(threat: Threat) -> None:
    graph = scene_with(actor(-50.0, 0.0))
    drive = LoggedDrive(vehicle(), torch.eye(4))
    sent = send_threat(threat, graph, drive, 1.0)
    velocity = {Threat.STATIONARY: (0, 0, 0), Threat.FRONTAL: (-5, 0, 0), Threat.SIDE: (0, 5, 0)}[threat]
    assert sent.velocity_mps == pytest.approx(velocity, abs=1e-5)  # from the right to the left
    simulator = begun(graph, (sent,))
    went_on = driven(simulator, replay(simulator))
    first = went_on.score.infractions[0]
    assert first.t_s == pytest.approx(AFTER_S, abs=0.3)
    reference = reference_mps(threat, drive, 1.0)
    assert first.severity == pytest.approx(reference, rel=0.05)
    assert threat_score(first.severity, reference) < 0.3


@pytest.mark.parametrize("threat", list(Threat))
def test_a_variation_hits_earlier_faster_and_beside(threat: Threat) -> None:
    graph, drive = scene_with(actor(-50.0, 0.0)), LoggedDrive(vehicle(), torch.eye(4))
    varied = Variation(after_s=3.0, speed_mps=7.0, left_m=0.5)
    planned, sent = (send_threat(threat, graph, drive, 1.0, of) for of in (AS_PLANNED, varied))
    # A second earlier along the log, which drives straight on along x of the scene
    moved_m = np.subtract(sent.at_m, planned.at_m)
    assert moved_m == pytest.approx([-SPEED_MPS * 1.0, 0.5, 0.0], abs=1e-4)
    assert np.hypot(*sent.velocity_mps[:2]) == pytest.approx(0.0 if threat is Threat.STATIONARY else 7.0)
    simulator = begun(graph, (sent,))
    first = driven(simulator, replay(simulator)).score.infractions[0]
    assert first.t_s == pytest.approx(3.0, abs=0.3)
    assert first.severity == pytest.approx(reference_mps(threat, drive, 1.0, varied), rel=0.05)


def test_a_safety_test_ends_at_the_first_collision() -> None:
    graph = scene_with(actor(-50.0, 0.0))
    drive = LoggedDrive(vehicle(), torch.eye(4))
    simulator = begun(graph, (send_threat(Threat.STATIONARY, graph, drive, 1.0),))
    scenario = dataclasses.replace(simulator.scenario, ends_on_collision=True)
    went_on = drive_route(simulator, scenario, replay(simulator), route="log")
    result = judge(Threat.STATIONARY, went_on, SPEED_MPS)
    assert went_on.score.ending is Ending.COLLISION
    assert result.outcome is Outcome.COLLIDED
    assert result.impact_s == went_on.score.duration_s == pytest.approx(AFTER_S, abs=0.3)
    assert result.progress == pytest.approx(SPEED_MPS * AFTER_S / simulator.length_m, abs=0.05)


def test_an_agent_that_breaks_off_is_not_scored() -> None:
    graph = scene_with(actor(-50.0, 0.0))
    drive = LoggedDrive(vehicle(), torch.eye(4))
    simulator = begun(graph, (send_threat(Threat.SIDE, graph, drive, 1.0),))

    class Lost:
        def act(self, observation):  # type: ignore[no-untyped-def]
            return dataclasses.replace(
                StraightAgent(SPEED_MPS).act(observation), xy=torch.full((1, 1, 6, 2), torch.nan)
            )

    result = judge(Threat.SIDE, driven(simulator, Lost()), SPEED_MPS)
    assert (result.outcome, result.score) == (Outcome.FAILED, None)


def test_who_brakes_in_time_is_not_hit_by_what_stands() -> None:
    graph = scene_with(actor(-50.0, 0.0))
    drive = LoggedDrive(vehicle(), torch.eye(4))
    simulator = begun(graph, (send_threat(Threat.STATIONARY, graph, drive, 1.0),))
    braked = driven(simulator, StraightAgent(0.0))
    assert braked.score.infractions == ()
    result = judge(Threat.STATIONARY, braked, SPEED_MPS)
    assert (result.outcome, result.score) == (Outcome.STOPPED_SHORT, 5.0)
    assert result.progress < 0.5


def test_threats_need_a_car_and_a_moving_log() -> None:
    drive = LoggedDrive(vehicle(), torch.eye(4))
    with pytest.raises(InputError, match="no car"):
        send_threat(Threat.SIDE, scene_with(actor(9.0, 0.0, Category.PEDESTRIAN)), drive, 1.0)
    with pytest.raises(InputError, match="too early for an impact"):
        send_threat(Threat.SIDE, scene_with(FAR), drive, END_S - 2.0)
    with pytest.raises(InputError, match=r"drives on for 1\.0 m after an impact at .* s, and 5 m are needed"):
        send_threat(Threat.SIDE, scene_with(FAR), drive, END_S - 4.0 - 1.0 / SPEED_MPS)


def test_a_shifted_ego_vehicle_drives_beside_the_log() -> None:
    simulator = begun(scene_with(FAR), (ShiftEgo((0.0, 2.0, 0.0)),))
    beside = np.linalg.inv(LoggedDrive(vehicle(), torch.eye(4)).pose_at(1.0)) @ simulator.drive.pose_at(1.0)
    assert np.allclose(beside[:3, 3], [0, 2, 0], atol=1e-5)
    assert driven(simulator, replay(simulator)).score.ending is Ending.COMPLETED


class OnceTrusted:
    """A renderer without sensors that trusts the first metres of the log alone."""

    def __init__(self, until_m: float) -> None:
        self.rig, self._until_m = vehicle().rig, until_m

    def render(self, T_world_ego: torch.Tensor, twist_ego: torch.Tensor, t_s: float) -> Rendered:
        along = inverse_se3(vehicle().T_world_scene) @ T_world_ego
        return Rendered(no_images(), None, float(along[0, 3]) < self._until_m)


@pytest.mark.parametrize("stays", [False, True])
def test_a_drive_knows_how_much_of_it_was_trusted_and_may_end_there(stays: bool) -> None:
    graph, log = scene_with(actor(500.0, 0.0)), LoggedDrive(vehicle(), torch.eye(4))
    simulator = ReconstructedSimulator(OnceTrusted(30.0), graph.tracks, log)
    scenario = ReconstructedScenario(1.0, length_s=6.0, stays_trusted=stays)
    drive = drive_route(simulator, scenario, StraightAgent(SPEED_MPS), route="r")
    # From 8 m on at 8 m/s: key frames at 8, 12, … m; 28 m is the last one before 30 m
    trusted = [True] * 6 + [False] * (1 if stays else 7)
    assert list(simulator.state.trusted) == trusted
    assert simulator.trusted_share == pytest.approx(6 / len(trusted))
    result = judge(Threat.STATIONARY, drive, 8.0)
    if stays:
        assert drive.score.ending is Ending.UNTRUSTED
        assert (result.outcome, result.score) == (Outcome.UNTRUSTED, None)
        assert drive.states[-1].x_m != drive.states[-2].x_m
    else:
        assert drive.score.ending is Ending.COMPLETED
        assert (result.outcome, result.score) == (Outcome.PASSED, 5.0)


def test_a_renderer_that_says_nothing_leaves_the_share_open() -> None:
    simulator = begun(scene_with(actor(500.0, 0.0)))
    assert simulator.trusted_share is None
