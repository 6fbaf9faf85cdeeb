"""CARLA's client without a server: what it says then, its maps beside ours, its weather."""

import sys
from typing import Any

import numpy as np
import pytest

from foredrive.errors import InputError
from foredrive.integrations.carla.client import connect, import_carla, require_same_version
from foredrive.integrations.carla.frames import CarlaPose, matrix_of
from foredrive.integrations.carla.road import CarlaLaneRules
from foredrive.integrations.carla.session import CarlaSession
from foredrive.integrations.carla.simulator import weather_of
from foredrive.scene.conditions import CONDITIONS
from foredrive.towns.map.loading import load_town_map

from carla_stand_in import Client, World  # isort: skip


def test_no_client_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(InputError, match=r"pip install 'foredrive\[carla\]'"):
        import_carla()


def test_no_server_is_one_line(carla: Any) -> None:
    with pytest.raises(InputError, match=r"no CARLA server answers at localhost:9 within 0.2 s") as caught:
        connect(port=9, timeout_s=0.2)
    assert "\n" not in str(caught.value)


def test_another_version_is_refused() -> None:
    require_same_version("0.9.16", "0.9.16", "localhost:2000")
    with pytest.raises(InputError, match=r"version 0\.9\.15, the client 0\.9\.16"):
        require_same_version("0.9.16", "0.9.15", "localhost:2000")


def test_carlas_lanes_are_ours(carla: Any, town02: Any) -> None:
    """The middle of every lane of Town02 outside of junctions: place, heading, width."""
    lanes = [lane for lane in load_town_map("Town02").lanes if lane.junction_id is None]
    assert len(lanes) > 20
    for lane in lanes:
        k = len(lane.centreline_xyz) // 2
        before, here = lane.centreline_xyz[k - 1], lane.centreline_xyz[k]
        waypoint = town02.get_waypoint(carla.Location(here[0], -here[1], here[2]))
        T = matrix_of(waypoint.transform)
        ahead = (here - before)[:2] / np.linalg.norm((here - before)[:2])
        off = T[:2, 3] - here[:2]
        assert abs(ahead[0] * off[1] - ahead[1] * off[0]) < 0.1
        assert abs(off @ ahead) < 0.5  # CARLA finds the nearest point of a lane to some decimetres
        assert T[:2, 0] @ ahead > 0.99
        assert waypoint.lane_width == pytest.approx(lane.width_m, abs=0.1)


def test_lanes_are_left_and_driven_the_wrong_way(carla: Any, town02: Any) -> None:
    road = CarlaLaneRules(World(carla, town02))
    lane = next(
        wp for wp in town02.generate_waypoints(20.0) if not wp.is_junction and wp.get_right_lane() is not None
    )
    T = matrix_of(lane.transform)
    forward, left = T[:3, 0], T[:3, 1]
    yaw = float(np.arctan2(forward[1], forward[0]))
    assert not road.is_outside(T[:3, 3], yaw)
    assert road.is_outside(T[:3, 3], yaw + np.pi)
    assert road.is_outside(T[:3, 3] - (0.5 * lane.lane_width + 1.5) * left, yaw)
    assert not road.is_outside(T[:3, 3] - (0.5 * lane.lane_width + 1.0) * left, yaw)
    assert road.lights().tolist() == []


def test_weather_is_carlas(carla: Any) -> None:
    clear, rain, fog, night = (weather_of(CONDITIONS[n]) for n in ("clear", "night_rain", "fog", "night"))
    assert clear.sun_altitude_angle == pytest.approx(75.0)
    assert (clear.precipitation, clear.fog_density, clear.cloudiness) == pytest.approx((0.0, 0.0, 20.0))
    assert night.sun_altitude_angle < -40
    assert 40 < rain.precipitation < 70
    assert rain.wetness == pytest.approx(90.0)
    assert fog.fog_density == pytest.approx(82.4, abs=0.1)  # log10(1000 / 150)
    assert rain.sun_altitude_angle < 0


def test_an_unknown_blueprint_or_attribute_is_named(carla: Any, town02: Any) -> None:
    world = World(carla, town02)
    client = Client(world)
    pose = CarlaPose(0.0, 0.0, 0.0)
    with CarlaSession(client, "Town02", 1) as session:
        with pytest.raises(InputError, match=r"no blueprint 'vehicle.none'"):
            session.spawn("vehicle.none", pose, {})
        with pytest.raises(InputError, match="no attribute 'colour'"):
            session.spawn("sensor.camera.rgb", pose, {"colour": "red"})
    assert not world.settings.synchronous_mode


def test_a_step_of_leaving_that_fails_does_not_keep_the_others_from_being_made(
    carla: Any, town02: Any, caplog: pytest.LogCaptureFixture
) -> None:
    class Stubborn(Client):
        def apply_batch(self, commands: list[Any]) -> None:
            raise RuntimeError("time-out while destroying")

    client = Stubborn(World(carla, town02))
    with CarlaSession(client, "Town02", 1):
        assert client.traffic.synchronous
    assert not client.traffic.synchronous
    assert not client.world.settings.synchronous_mode
    assert "time-out while destroying" in caplog.text
