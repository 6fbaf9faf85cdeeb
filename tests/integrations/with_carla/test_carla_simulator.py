"""CARLA as a simulator, against a stand-in for its server; what is left behind, whatever goes wrong."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from carla_stand_in import Client, Light, World

from foredrive.driving.drive import drive_route
from foredrive.driving.dynamics import EGO
from foredrive.driving.route_scenario import RouteScenario
from foredrive.driving.scores import Ending
from foredrive.driving.simple_agents import StraightAgent
from foredrive.errors import InputError
from foredrive.integrations.carla.simulator import CarlaSimulator
from foredrive.scene import Category, Command, Control
from foredrive.scene.conditions import BackgroundTraffic, find_conditions
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import VehicleSensors, roof_lidar

SENSORS = VehicleSensors(camera_rig((9, 16)), roof_lidar(channels=2, azimuth_steps=60))


@pytest.fixture
def world(carla: Any, town02: Any) -> World:
    return World(carla, town02)


def lane_ahead(carla: Any, town02: Any, length_m: int) -> list[Any]:
    """Waypoints a metre apart along a straight lane of Town02 that leads away from no junction so soon."""
    for start in town02.generate_waypoints(5.0):
        ahead = [start, *(start.next(float(m))[0] for m in range(1, length_m + 1) if start.next(float(m)))]
        turned = {round(wp.transform.rotation.yaw % 360.0) for wp in ahead}
        if len(ahead) == length_m + 1 and len(turned) == 1 and not any(wp.is_junction for wp in ahead):
            return ahead
    raise AssertionError("Town02 has straight lanes")


@pytest.fixture
def lane(carla: Any, town02: Any) -> list[Any]:
    return lane_ahead(carla, town02, 60)


@pytest.fixture
def scenario(lane: list[Any]) -> RouteScenario:
    at = [wp.transform.location for wp in lane]
    route = np.array([[place.x, -place.y, place.z] for place in at])
    return RouteScenario(
        "Town02", route, seed=7, background_traffic=BackgroundTraffic(vehicles=0, pedestrians=0)
    )


def is_left_as_found(world: World, client: Client) -> bool:
    return not world.settings.synchronous_mode and not client.traffic.synchronous and not world.actors


def test_a_drive_begins_at_rest_at_the_start_of_the_route(world: World, scenario: RouteScenario) -> None:
    client = Client(world)
    with CarlaSimulator(client) as simulator:
        clip = simulator.reset(dataclasses.replace(scenario, past_frames=2, sensors=SENSORS))
        assert world.settings.synchronous_mode
        assert world.settings.fixed_delta_seconds == pytest.approx(0.05)
        assert client.traffic.synchronous
        assert client.traffic.seed == 7
        assert clip.t_s.tolist() == [-1.0, -0.5, 0.0]
        np.testing.assert_allclose(clip.T_world_ego[-1, :2, 3], scenario.route_xyz[0, :2], atol=1e-3)
        ahead = scenario.route_xyz[10] - scenario.route_xyz[0]
        np.testing.assert_allclose(clip.T_world_ego[-1, :3, 0], ahead / np.linalg.norm(ahead), atol=1e-3)
        # Each key frame has the picture of its own frame; the last tick was now's.
        assert clip.images.shape == (3, 6, 3, 9, 16)
        assert clip.images[:, 0, 0, 0, 0].tolist() == [(world.frame - k) % 256 for k in (20, 10, 0)]
        assert clip.sweeps.returned.shape == (3, 2)
        assert not clip.misses_known.any()
        assert clip.command == Command.STRAIGHT
        assert not clip.boxes.valid.any()
    assert is_left_as_found(world, client)


def test_what_is_asked_for_is_driven_although_the_engine_is_weaker(
    world: World, scenario: RouteScenario
) -> None:
    with CarlaSimulator(Client(world)) as simulator:
        clip = simulator.reset(dataclasses.replace(scenario, sensors=SENSORS))
        clips = [simulator.step(Control(1.5, 0.0)).clip for _ in range(40)]
        assert simulator.state.t_s == pytest.approx(2.0)
        assert simulator.ego().speed_mps == pytest.approx(3.0, abs=0.25)
        assert simulator.state.progress.done_m == pytest.approx(3.0, abs=1.0)
        assert all(c is clip for c in clips[:9])
        assert clips[9] is clips[18] is not clips[19]
        assert clips[19].t_s.tolist() == [-0.5, 0.0]
        before = simulator.ego().yaw_rad
        for _ in range(20):
            simulator.step(Control(0.0, 0.1))
        # 3 m further at a curvature of tan(.1) / 2.86 m: .105 rad to the left.
        assert simulator.ego().yaw_rad - before == pytest.approx(0.105, abs=0.015)
        assert simulator.ego().steering_rad == pytest.approx(0.1, abs=1e-6)
        for _ in range(60):
            simulator.step(Control(-3.0, 0.0))
        assert simulator.ego().speed_mps == 0.0


def test_the_route_ends_where_it_ends(world: World, scenario: RouteScenario) -> None:
    with CarlaSimulator(Client(world)) as simulator:
        simulator.reset(dataclasses.replace(scenario, route_xyz=scenario.route_xyz[:20]))
        steps = [simulator.step(Control(2.0, 0.0)) for _ in range(80) if simulator.state.ended is None]
        assert steps[-1].done
        assert [event.kind for event in steps[-1].events] == ["completed"]
        assert simulator.state.rules.outside_m == 0.0
        with pytest.raises(InputError, match="reset"):
            simulator.step(Control(0.0, 0.0))


@pytest.mark.parametrize(("shows", "runs"), [("Red", True), ("Green", False), ("Yellow", False)])
def test_a_red_light_is_run(
    carla: Any, world: World, scenario: RouteScenario, lane: list[Any], shows: str, runs: bool
) -> None:
    world.furniture = [Light(5, lane[25], getattr(carla.TrafficLightState, shows))]
    with CarlaSimulator(Client(world)) as simulator:
        simulator.reset(scenario)
        events = [e for _ in range(120) for e in simulator.step(Control(2.0, 0.0)).events]
    assert [e.kind for e in events if e.kind == "red_light"] == ["red_light"] * runs


@pytest.mark.parametrize("stops", [True, False])
def test_a_stop_sign_wants_a_stop(
    carla: Any, world: World, scenario: RouteScenario, lane: list[Any], stops: bool
) -> None:
    volume = carla.BoundingBox(carla.Location(0, 0, 0), carla.Vector3D(1.5, 1.5, 1.0))
    at = lane[25].transform
    sign = SimpleNamespace(id=6, type_id="traffic.stop", attributes={}, trigger_volume=volume)
    sign.get_transform = lambda: at
    world.furniture = [sign]
    with CarlaSimulator(Client(world)) as simulator:
        simulator.reset(scenario)
        events = []
        for _ in range(400):
            # The bumper is 4.1 m before the axle: 17.5 m are 3.4 m before the line.
            brakes = stops and 15.0 < simulator.state.progress.done_m < 19.0 and not waited(simulator)
            step = simulator.step(Control(-6.0 if brakes else 1.0, 0.0))
            events += step.events
            if step.done:
                break
    assert [e.kind for e in events if e.kind == "stop_sign"] == ["stop_sign"] * (not stops)


def test_an_agent_drives_and_is_scored_as_in_a_town(world: World, scenario: RouteScenario) -> None:
    route = dataclasses.replace(scenario, route_xyz=scenario.route_xyz[:40])
    with CarlaSimulator(Client(world)) as simulator:
        drive = drive_route(simulator, route, StraightAgent(5.0), route="0")
    assert drive.score.ending is Ending.COMPLETED
    assert drive.score.driving_score_1_0 == 100.0
    assert drive.score.infractions == ()
    assert drive.score.duration_s == pytest.approx(34.0 / 5.0 + 2.0, abs=2.0)


def waited(simulator: CarlaSimulator) -> bool:
    return bool(simulator.state.rules.stopped_at)


def test_lanes_are_left(world: World, scenario: RouteScenario) -> None:
    with CarlaSimulator(Client(world)) as simulator:
        simulator.reset(scenario)
        for _ in range(160):
            if simulator.step(Control(1.5, -0.15)).done:
                break
        assert simulator.state.rules.outside_m > 1.0


def test_who_is_hit_is_told_once(carla: Any, world: World, scenario: RouteScenario) -> None:
    def other(number: int, type_id: str, base_type: str = "") -> Any:
        velocity = carla.Vector3D(0.0, 0.0, 0.0)
        attributes = {"base_type": base_type} if base_type else {}
        return SimpleNamespace(
            id=number, type_id=type_id, attributes=attributes, get_velocity=lambda: velocity
        )

    with CarlaSimulator(Client(world)) as simulator:
        simulator.reset(scenario)
        world.collide(other(0, "static.building"))
        assert simulator.step(Control(2.0, 0.0)).events == []  # who stands hits nobody
        for _ in range(30):
            simulator.step(Control(2.0, 0.0))
        speed = simulator.ego().speed_mps
        for _ in range(3):  # in contact for some steps
            world.collide(other(41, "vehicle.bh.crossbike", "bicycle"))
        hits = list(simulator.step(Control(0.0, 0.0)).events)
        world.collide(other(41, "vehicle.bh.crossbike", "bicycle"))
        hits += simulator.step(Control(0.0, 0.0)).events
        assert [(hit.kind, hit.what) for hit in hits] == [("collision_vehicle", "bicycle")]
        assert hits[0].severity == pytest.approx(speed, abs=1e-6)
        for _ in range(40):  # 6 m on
            simulator.step(Control(0.0, 0.0))
        world.collide(other(42, "walker.pedestrian.0001"))
        assert [e.kind for e in simulator.step(Control(0.0, 0.0)).events] == ["collision_pedestrian"]


def test_others_are_seen_as_boxes(carla: Any, world: World, scenario: RouteScenario, lane: list[Any]) -> None:
    """A bicycle stands on the route, 20 m ahead of the start."""
    thing = world.get_blueprint_library().find("vehicle.bh.crossbike")
    thing.set_attribute("base_type", "bicycle")
    there = lane[20].transform
    bicycle = world.try_spawn_actor(thing, there)
    assert bicycle is not None
    with CarlaSimulator(Client(world)) as simulator:
        clip = simulator.reset(scenario)
    boxes = clip.boxes[clip.now]
    assert boxes.category.tolist() == [Category.BICYCLE]
    assert boxes.centre[0].tolist() == pytest.approx([20.0, 0.0, 0.75], abs=0.02)
    assert float(boxes.yaw[0]) == pytest.approx(0.0, abs=0.01)
    assert boxes.size_lwh[0].tolist() == pytest.approx([4.892, 1.836, 1.49], abs=1e-3)
    assert world.actors == [bicycle]  # what was there before us stays


def test_traffic_and_people_are_added(world: World, scenario: RouteScenario) -> None:
    client = Client(world)
    night = find_conditions("night_rain")
    with CarlaSimulator(client) as simulator:
        simulator.reset(
            dataclasses.replace(
                scenario, background_traffic=BackgroundTraffic(vehicles=4, pedestrians=3), conditions=night
            )
        )
        kinds = [actor.type_id.split(".")[0] for actor in world.actors]
        assert (kinds.count("walker"), kinds.count("controller")) == (3, 3)
        drivers = [actor for actor in world.actors if actor.attributes.get("role_name") == "autopilot"]
        assert [driver.autopilot for driver in drivers] == [(True, 8000)] * 4
        assert all(0.8 <= a.max_speed_mps <= 1.8 for a in world.actors if a.type_id.startswith("controller"))
        start = world.hero.get_transform().location
        assert min(start.distance(d.get_transform().location) for d in drivers) > 2.0
        assert world.weather.sun_altitude_angle < 0
        assert world.weather.precipitation > 40
    assert is_left_as_found(world, client)


def test_whatever_goes_wrong_the_server_is_left_as_it_was(world: World, scenario: RouteScenario) -> None:
    client, quick = Client(world), dataclasses.replace(scenario, sensors=SENSORS)
    simulator = CarlaSimulator(client, timeout_s=0.05)
    world.full = True
    with pytest.raises(InputError, match="no room"):
        simulator.reset(quick)
    assert is_left_as_found(world, client)
    world.full, world.mute = False, True
    with pytest.raises(InputError, match="PCAM_F0 has sent nothing"):
        simulator.reset(quick)
    assert is_left_as_found(world, client)
    world.mute = False
    simulator.reset(quick)
    world.dead_at = world.frame + 1
    with pytest.raises(InputError, match="a simulation step: time-out"):
        simulator.step(Control(0.0, 0.0))
    assert is_left_as_found(world, client)
    world.dead_at = float("inf")
    with pytest.raises(InputError, match="no Town99; it has Town01, Town02"):
        simulator.reset(dataclasses.replace(quick, town="Town99"))
    with pytest.raises(InputError, match="longer than the vehicle"):
        simulator.reset(dataclasses.replace(quick, route_xyz=quick.route_xyz[:2]))
    simulator.reset(quick)
    with pytest.raises(InputError, match="finite"):
        simulator.step(Control(float("nan"), 0.0))
    with pytest.raises(KeyboardInterrupt), simulator:
        raise KeyboardInterrupt
    assert is_left_as_found(world, client)
    assert EGO.length_m == pytest.approx(
        2 * 2.446, abs=0.01
    )  # the stand-in's vehicle is the one of that size
