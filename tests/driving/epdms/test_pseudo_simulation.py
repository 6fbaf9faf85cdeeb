"""Two-stage pseudo-simulation on a straight street, without rendering."""

import dataclasses

import numpy as np
import pytest
import torch
from driving.replay.test_agents_of_logs import YAW, logged, seen

from foredrive.driving.epdms.comfort import history_comfort
from foredrive.driving.epdms.pseudo_simulation import (
    BODY,
    FOLLOW_UPS,
    PseudoSimulation,
    figures_of,
    past_motion,
    simulated,
)
from foredrive.driving.epdms.world import Roads
from foredrive.driving.ncap.running import Place
from foredrive.driving.observation import no_images
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.replay.reconstructed import ReconstructedSimulator
from foredrive.driving.replay.replay_expert import ReplayExpert
from foredrive.driving.simple_agents import StraightAgent, plan_of
from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3
from foredrive.methods.reconstruction.renderer import ReconstructedRenderer
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.vehicle import LoggedVehicle
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.content import GaussianContent
from foredrive.methods.splatad.scene import GaussianScene
from foredrive.scene import Category, Clip, Rendered, Trajectory
from foredrive.scene.road_map import RoadMap

SPEED = 8.0


def outline(x0: float, x1: float, y0: float, y1: float) -> np.ndarray:
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    R = np.array([[np.cos(YAW), -np.sin(YAW)], [np.sin(YAW), np.cos(YAW)]])
    return corners @ R.T + [100.0, -40.0]


def roads() -> Roads:
    lane = outline(-50.0, 200.0, -2.0, 2.0)
    middle = outline(-50.0, 200.0, 0.0, 0.0)[:2]
    return Roads(RoadMap((lane,), (True,), (lane, outline(-50, 200, -4, 4)), (), middle))


def place(at_x: float | None = None) -> Place:
    """With a car that stands on the path, or without."""
    times = torch.arange(0.0, 12.0, 0.5)
    count = 0 if at_x is None else 1
    T = torch.eye(4).repeat(count, len(times), 1, 1)
    T[..., 0, 3] = at_x or 0.0
    T[..., 2, 3] = 0.8
    tracks = ActorTracks(
        torch.arange(count) + 5,
        torch.full((count,), int(Category.CAR)),
        torch.tensor([[4.5, 1.9, 1.6]]).repeat(count, 1),
        times,
        T,
        torch.ones(count, len(times), dtype=torch.bool),
    )

    one = Gaussians(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3), torch.zeros(1), torch.ones(1, 5)
    )
    graph, vehicle = SceneGraph(tracks, GaussianContent(one, torch.zeros(1, dtype=torch.int64))), long_log()
    scene = GaussianScene(graph, cameras=1)
    return Place(graph, vehicle, lambda changed: ReconstructedRenderer(scene, changed, vehicle), {})


def long_log() -> LoggedVehicle:
    vehicle = logged(SPEED).vehicle
    times = torch.arange(0.0, 12.05, 0.1)
    T = torch.eye(4).repeat(len(times), 1, 1)
    T[:, 0, 3] = SPEED * times
    return dataclasses.replace(vehicle, t_s=times, T_scene_ego=T)


def run(agent_in: object, at_x: float | None = None, **changes: object) -> PseudoSimulation:
    chosen = {"follow_ups": FOLLOW_UPS[:2], **changes}
    return PseudoSimulation(place(at_x), roads(), agent_in, 1, sensors=False, **chosen)  # type: ignore[arg-type]


def test_who_drives_on_along_the_lane_has_nearly_all_points() -> None:
    simulation = run(lambda simulator: StraightAgent(SPEED))
    starts = simulation.starts_s(1.0)
    assert starts == [2.0, 3.0, 4.0, 5.0, 6.0]
    found = simulation.score(starts[0])
    assert (found.first.nc, found.first.dac, found.first.ttc, found.first.lk) == (1.0, 1.0, 1.0, 1.0)
    assert found.first.ep == pytest.approx(1.0, abs=0.02)
    assert found.score == pytest.approx(1.0, abs=0.06)
    assert len(found.second) == 2 * 2


@pytest.mark.slow
def test_who_stops_has_no_progress_and_who_hits_somebody_no_score() -> None:
    stops = run(lambda simulator: StraightAgent(0.0)).score(2.0)
    assert stops.first.nc == 1.0
    assert stops.first.ep < 0.5
    hits = run(lambda simulator: StraightAgent(SPEED), at_x=30.0).score(2.0)
    assert hits.first.nc == 1.0  # the log does the same, so that it is forgiven
    expert = run(lambda simulator: ReplayExpert(simulator.drive), at_x=64.0).score(2.0)
    blind = run(lambda simulator: StraightAgent(SPEED), at_x=64.0).score(2.0)
    assert min(scores.nc for scores in expert.second) == 1.0
    assert min(scores.nc for scores in blind.second) == 0.0


def test_the_second_stage_starts_beside_the_path_with_a_past_of_its_own() -> None:
    places = list[tuple[float, float]]()

    class Looks:
        def __init__(self, simulator: ReconstructedSimulator) -> None:
            self.simulator = simulator

        def act(self, observation: Clip) -> Trajectory:
            pose = observation.T_world_ego[0].numpy()
            R = np.array([[np.cos(YAW), -np.sin(YAW)], [np.sin(YAW), np.cos(YAW)]])
            local = (pose[:, :2, 3] - [100.0, -40.0]) @ R
            places.append((local[-1, 1], local[-1, 0] - local[-2, 0]))
            return StraightAgent(SPEED).act(observation)

    run(Looks, follow_ups=FOLLOW_UPS[4:6]).score(2.0)
    aside = sorted({round(float(y), 2) for y, _ in places})
    assert aside == [-0.8, 0.0, 0.8]
    np.testing.assert_allclose([moved for _, moved in places], 4.0, atol=0.03)


def test_a_plan_is_followed_by_the_regulator() -> None:
    state = logged(SPEED).state_at(3.0)
    ego = simulated(StraightAgent(SPEED).act(seen(0.0, SPEED)), state)
    assert len(ego.yaw_rad) == 31
    gone = np.hypot(*(ego.xy_m[-1] - ego.xy_m[0]))
    assert gone == pytest.approx(24.0, abs=0.1)
    short = plan_of(torch.ones(1, 1, 4, 2))
    with pytest.raises(InputError, match="a plan of 3 s is needed, got 2 s"):
        simulated(short, state)


def test_the_past_is_that_of_the_log() -> None:
    """14 states, as in the devkit (`_calculate_history_comfort`), which drops the one before now."""
    past = past_motion(logged(SPEED), 3.0)
    assert len(past.yaw_rad) == 14
    # 3.0 m/s from x = 0: two steps of 0.1 s before 3 s, and 1.5 s before
    end_m = np.array([logged(SPEED).state_at(t_s).x_m for t_s in (1.5, 2.8)])
    np.testing.assert_allclose(past.xy_m[[0, -1], 0], end_m, atol=1e-6)
    np.testing.assert_allclose(past.speed_mps, SPEED, atol=0.02)
    np.testing.assert_allclose(past.acceleration_mps2, 0.0, atol=0.2)


def test_a_simulated_plan_begins_with_the_acceleration_of_the_log() -> None:
    """The log brakes by 5 m/s², more than the bound of 4.05, and the plan keeps its speed from there on."""
    braking = long_log()
    times = braking.t_s
    way = SPEED * times - 0.5 * 5.0 * (times - 2.0).clamp(min=0.0, max=1.2) ** 2
    T = torch.eye(4).repeat(len(times), 1, 1)
    T[:, 0, 3] = way
    drive = LoggedDrive(dataclasses.replace(braking, T_scene_ego=T), torch.eye(4))
    state = drive.state_at(2.5)
    assert state.acceleration_mps2 == pytest.approx(-5.0, abs=0.05)
    past, ego = past_motion(drive, 2.5), simulated(StraightAgent(5.5).act(seen(0.0, 5.5)), state)
    assert ego.acceleration_mps2[0] == state.acceleration_mps2
    assert history_comfort(past, ego, BODY) == 0.0
    calm = dataclasses.replace(ego, acceleration_mps2=0 * ego.acceleration_mps2)
    assert history_comfort(past_motion(logged(SPEED), 2.5), calm, BODY) == 1.0


def test_failed_starts_are_counted_and_have_no_share() -> None:
    found = run(lambda simulator: StraightAgent(SPEED)).score(2.0)
    figures = figures_of([found], failed=2)
    assert (figures["starts"], figures["failed"]) == (3, 2)
    assert figures["epdms"] == found.score
    assert figures_of([], failed=1)["epdms"] is None


class TrustsThePath:
    """A renderer without sensors that trusts places on the logged path alone."""

    def __init__(self, vehicle: LoggedVehicle) -> None:
        self.rig, self._T_world_scene = vehicle.rig, vehicle.T_world_scene

    def render(self, T_world_ego: torch.Tensor, twist_ego: torch.Tensor, t_s: float) -> Rendered:
        along = inverse_se3(self._T_world_scene) @ T_world_ego
        return Rendered(no_images(), None, abs(float(along[1, 3])) < 0.5)


def test_the_share_of_trusted_follow_ups_stands_beside_the_score() -> None:
    """Of three follow-up states two lie 0.8 m beside the path."""
    where = place()
    where = dataclasses.replace(where, renderer=lambda graph: TrustsThePath(where.vehicle))
    agent = StraightAgent(SPEED)
    simulation = PseudoSimulation(where, roads(), lambda simulator: agent, 1, follow_ups=FOLLOW_UPS[3:6])
    scored = simulation.score(2.0)
    assert scored.trusted_share == pytest.approx(1 / 3)
    figures = figures_of([scored, dataclasses.replace(scored, trusted_share=1.0)], 0)
    assert figures["second.trusted_share"] == pytest.approx(2 / 3)
    unsaid = run(lambda simulator: agent, follow_ups=FOLLOW_UPS[3:4]).score(2.0)
    assert figures_of([unsaid], 0)["second.trusted_share"] is None
