"""A town answers: drives that can be saved and repeated, and what goes wrong in them."""

import dataclasses
import pickle
import weakref

import numpy as np
import pytest
import torch

from foredrive.driving.collisions import Contacts, RoadUsers
from foredrive.driving.controller import ControllerState, follow
from foredrive.driving.dynamics import STEP_S
from foredrive.driving.plans import fixed_in_world
from foredrive.errors import InputError
from foredrive.scene import Category, Clip, Command, Control, Event, Trajectory
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.driving import town
from foredrive.towns.driving.town import TownScenario, TownSimulator
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.world import World

SEED = 3
CROWD = BackgroundTraffic(vehicles=12, pedestrians=8)
SENSORS = SensorSuite(camera_rig((9, 16)), roof_lidar(channels=4, azimuth_steps=60))
BRAKE = Control(-3.0, 0.0)


def straight_route(length_m: float = 120.0) -> np.ndarray:
    """Along the longest lane of Town02 outside of junctions, from 20 m on."""
    graph = Traffic(load_town_map("Town02"), SEED, 1, 0).lanes
    lane = int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))
    return graph.position(np.full(int(length_m), lane), 20.0 + np.arange(int(length_m)))


@pytest.fixture(scope="module")
def scenario() -> TownScenario:
    return TownScenario("Town02", straight_route(), SEED, background_traffic=CROWD)


@pytest.fixture(scope="module")
def simulator() -> TownSimulator:
    return TownSimulator()


def drive(simulator: TownSimulator, control: Control, steps: int, cruise_mps: float = 99.0) -> list[Event]:
    events: list[Event] = []
    for _ in range(steps):
        now = control if simulator.state.ego.speed_mps < cruise_mps else Control(0.0, control.steering_rad)
        step = simulator.step(now)
        events += step.events
        if step.done:
            break
    return events


def test_a_first_observation_has_a_past(simulator: TownSimulator, scenario: TownScenario) -> None:
    clip = simulator.reset(dataclasses.replace(scenario, past_frames=2, sensors=SENSORS))
    assert clip.t_s.tolist() == [-1.0, -0.5, 0.0]
    assert clip.images.shape == (3, 6, 3, 9, 16)
    assert clip.images.float().std() > 5  # something to be seen
    assert clip.sweeps.returned.shape == (3, 4 * 60)
    assert clip.sweeps.returned.any(-1).all()
    assert clip.boxes.valid.any()
    assert not clip.future.valid.any()
    assert clip.command == Command.STRAIGHT
    torch.testing.assert_close(clip.T_world_ego[0], clip.T_world_ego[2])
    moved = [(clip.boxes.centre[t], clip.boxes.track_id[t]) for t in (0, 2)]
    both = set(moved[0][1].tolist()) & set(moved[1][1].tolist()) - {0}
    ways = [moved[1][0][moved[1][1] == i] - moved[0][0][moved[0][1] == i] for i in both]
    assert max(float(way.norm()) for way in ways) > 1.0  # the others drove before the drive began


def test_sensors_see_key_frames_only(simulator: TownSimulator, scenario: TownScenario) -> None:
    clip = simulator.reset(dataclasses.replace(scenario, sensors=SENSORS))
    clips: list[Clip] = [simulator.step(Control(2.0, 0.0)).clip for _ in range(20)]
    assert all(c is clip for c in clips[:9])
    assert all(c is clips[9] for c in clips[9:19])
    assert clips[19].t_s.tolist() == [-0.5, 0.0]
    # From rest at 2 m/s², after the .07 s that the force takes to build up.
    assert clips[19].ego_speed_mps[-1] == pytest.approx(2.0, abs=0.1)
    here = clips[19].T_world_ego[:, :3, 3]
    assert float((here[1] - here[0]).norm()) == pytest.approx(0.75, abs=0.08)
    assert not torch.equal(clips[19].images[1], clips[9].images[1])


def test_a_saved_drive_goes_on_bit_by_bit(simulator: TownSimulator, scenario: TownScenario) -> None:
    simulator.reset(dataclasses.replace(scenario, sensors=SENSORS))
    drive(simulator, Control(2.0, 0.01), 33)  # between two decisions of the others, and two key frames
    saved = pickle.loads(pickle.dumps(simulator.save()))
    ends = []
    for again in (False, True):
        if again:
            simulator.restore(saved)
        events = drive(simulator, Control(1.0, -0.02), 60)
        ends.append((pickle.dumps(simulator.state), events))
    assert ends[0][1] == ends[1][1]
    first, second = (pickle.loads(end[0]) for end in ends)
    assert first.ego == second.ego
    for name, value in vars(first.decided.vehicles).items():
        np.testing.assert_array_equal(value, getattr(second.decided.vehicles, name))
    np.testing.assert_array_equal(first.decided.people.xyz, second.decided.people.xyz)
    assert torch.equal(first.frames[-1].images, second.frames[-1].images)
    assert torch.equal(first.frames[-1].sweep.range_m, second.frames[-1].sweep.range_m)


def test_who_stands_breaks_no_rule_and_is_blocked_at_last(
    simulator: TownSimulator, scenario: TownScenario
) -> None:
    simulator.reset(
        dataclasses.replace(scenario, background_traffic=BackgroundTraffic(vehicles=3, pedestrians=0))
    )
    first = drive(simulator, BRAKE, 200)
    assert first == []
    state = simulator.state
    waited = dataclasses.replace(state, step_index=3600)
    simulator.restore(dataclasses.replace(simulator.save(), state=waited))
    step = simulator.step(BRAKE)
    assert step.done
    assert [event.kind for event in step.events] == ["blocked"]
    with pytest.raises(InputError, match="over"):
        simulator.step(BRAKE)


def test_going_on_blindly_leaves_the_lane_and_runs_into_something(
    simulator: TownSimulator, scenario: TownScenario
) -> None:
    simulator.reset(scenario)
    events = drive(simulator, Control(3.0, 0.03), 400, cruise_mps=10.0)
    static = [event for event in events if event.kind == "collision_static"]
    assert static
    assert static[0].severity > 3.0
    assert static[0].what in {"building", "pole", "vegetation", "structure", "sign", "parked car", "signal"}
    T = simulator.state.ego
    assert np.hypot(static[0].xy_world[0] - T.x_m, static[0].xy_world[1] - T.y_m) < 60.0
    assert simulator.state.rules.outside_m > 1.0


def test_what_stands_before_the_bumper_stops_the_vehicle(
    simulator: TownSimulator, scenario: TownScenario
) -> None:
    """Straight at a parked car."""
    simulator.reset(scenario)
    car = min(
        simulator._world.parked, key=lambda c: np.linalg.norm(c.centre_m[:2] - scenario.route_xyz[0, :2])
    )
    state = simulator.state
    away = 8.0 + 0.5 * car.size_lwh[0]
    forward = np.array([np.cos(car.yaw), np.sin(car.yaw)])
    x, y = car.centre_m[:2] - (away + 1.65) * forward
    ego = dataclasses.replace(state.ego, x_m=float(x), y_m=float(y), yaw_rad=car.yaw, speed_mps=6.0)
    simulator.restore(dataclasses.replace(simulator.save(), state=dataclasses.replace(state, ego=ego)))
    events = drive(simulator, Control(0.0, 0.0), 60)
    hits = [event for event in events if event.kind == "collision_static"]
    assert [hit.what for hit in hits] == ["parked car"]
    assert hits[0].severity == pytest.approx(6.0, abs=0.1)
    assert simulator.state.ego.speed_mps == 0.0
    # It stands where it met it: its bumper at the car's.
    moved = np.hypot(simulator.state.ego.x_m - x, simulator.state.ego.y_m - y)
    assert moved == pytest.approx(away - 2.45 - 0.5 * car.size_lwh[0], abs=0.45)


def test_who_is_run_into_is_told_once_with_the_speed_between_both(
    simulator: TownSimulator, scenario: TownScenario
) -> None:
    simulator.reset(scenario)
    state, sense = simulator.state, simulator._collisions
    ego = dataclasses.replace(state.ego, speed_mps=8.0)
    T = state.frames[-1].T_world_ego
    forward, left = T[:2, 0], T[:2, 1]

    def others(category: Category, ahead_m: float, aside_m: float, velocity: np.ndarray) -> RoadUsers:
        foot = T[:3, 3] + np.append((1.65 + ahead_m) * forward + aside_m * left, 0.0)
        return RoadUsers(
            track_id=np.array([7]),
            category=np.array([int(category)]),
            foot_m=foot[None],
            yaw=np.array([state.ego.yaw_rad]),
            half_lw=np.array([[0.3, 0.3] if category is Category.PEDESTRIAN else [2.0, 0.9]]),
            velocity_mps=velocity[None],
        )

    ahead = others(Category.BUS, 4.3, 0.0, 3.0 * forward)  # its rear .15 m behind our bumper
    events, contacts, stopped = sense.check(T, ego, ahead, Contacts(), 1.0)
    assert [(e.kind, e.what, e.t_s) for e in events] == [("collision_vehicle", "bus", 1.0)]
    assert events[0].severity == pytest.approx(5.0)
    assert stopped
    for t_s, count in ((1.05, 0), (5.9, 0), (6.5, 0), (11.6, 1)):  # in contact still; then not for 5.1 s
        events, contacts, _ = sense.check(T, ego, ahead, contacts, t_s)
        assert len(events) == count
    beside = others(Category.CAR, 0.0, 1.75, 8.0 * forward)  # scraping along
    events, _, stopped = sense.check(T, ego, beside, Contacts(), 1.0)
    assert [(e.kind, e.severity) for e in events] == [("collision_vehicle", pytest.approx(0.0, abs=1e-9))]
    assert not stopped
    person = others(Category.PEDESTRIAN, 2.6, 0.3, 1.5 * left)
    events, _, stopped = sense.check(T, ego, person, Contacts(), 1.0)
    assert [e.kind for e in events] == ["collision_pedestrian"]
    assert events[0].severity == pytest.approx(np.hypot(8.0, 1.5))
    assert not stopped
    apart = others(Category.CAR, 4.6, 0.0, np.zeros(2))
    assert sense.check(T, ego, apart, Contacts(), 1.0) == ([], Contacts(), False)


def test_the_plan_along_the_route_is_driven_to_its_end(
    simulator: TownSimulator, scenario: TownScenario
) -> None:
    """A controller follows waypoints on the route, 5 m/s, planned anew with every key frame."""
    clip = simulator.reset(dataclasses.replace(scenario, route_xyz=scenario.route_xyz[:60], limit_s=60.0))
    controller, seen, events = ControllerState(), None, []
    for _ in range(1200):
        state = simulator.state
        if clip is not seen:
            seen = clip
            ahead = scenario.route_xyz[:, :2] - [state.ego.x_m, state.ego.y_m]
            cos, sin = np.cos(state.ego.yaw_rad), np.sin(state.ego.yaw_rad)
            local = ahead @ np.array([[cos, -sin], [sin, cos]])
            first = int(np.searchsorted(local[:, 0], 0.0))
            xy = np.array(
                [
                    [np.interp(2.5 * (k + 1), local[first:, 0], local[first:, i]) for i in (0, 1)]
                    for k in range(6)
                ]
            )
            plan = Trajectory(
                xy=torch.from_numpy(xy)[None].float(),
                yaw=torch.zeros(1, 6),
                valid=torch.ones(1, 6, dtype=torch.bool),
                log_prob=torch.zeros(1),
                dt_s=0.5,
            )
            controller = controller.expecting(fixed_in_world(plan, state.ego, state.t_s), state.t_s)
        control, controller = follow(controller, state.ego, state.t_s)
        step = simulator.step(control)
        clip, events = step.clip, [*events, *step.events]
        if step.done:
            break
    assert simulator.state.ended == "completed"
    assert simulator.state.rules.outside_m == 0.0
    assert simulator.state.t_s == pytest.approx(55.0 / 5.0 + 2.0, abs=4.0)
    assert simulator.state.step_index * STEP_S == simulator.state.t_s


def test_a_route_that_begins_nowhere_is_refused(simulator: TownSimulator, scenario: TownScenario) -> None:
    with pytest.raises(InputError, match="no lane"):
        simulator.reset(dataclasses.replace(scenario, route_xyz=np.add(scenario.route_xyz, 500.0)))
    with pytest.raises(InputError, match="longer"):
        simulator.reset(dataclasses.replace(scenario, route_xyz=scenario.route_xyz[:2]))


def test_a_world_is_freed_before_the_next_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    """And kept while drives are in the same town with the same seed."""

    class Built(World):
        def __init__(self, town_map: TownMap, seed: int) -> None:
            assert all(world() is None for world in built)
            built.append(weakref.ref(self))

    built = list[weakref.ref[Built]]()
    monkeypatch.setattr(town, "World", Built)
    monkeypatch.setattr(town, "_grown", {})
    for seed in (1, 1, 2, 2, 1):
        town.grow("Town02", seed)
    assert len(built) == 3
