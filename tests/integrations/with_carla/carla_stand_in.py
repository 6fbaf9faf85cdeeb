"""What stands in for CARLA's server: it speaks the client's types, and its vehicle is not the one we assume.

One vehicle on a flat plane, as weak as WEAK says; lights that show what they are told to; sensors that send
with every tick. It remembers what it was asked to do, so that a test can see what was left behind.
"""

import fnmatch
import math
from types import SimpleNamespace
from typing import Any

import numpy as np

STEP_S = 0.05
WEAK = 0.75
"""Its engine gives this much of what the pedal model says."""
BLUEPRINTS = {
    "vehicle.lincoln.mkz_2020": ("role_name", "base_type", "number_of_wheels"),
    "vehicle.bh.crossbike": ("role_name", "base_type", "number_of_wheels"),
    "walker.pedestrian.0001": ("is_invincible",),
    "controller.ai.walker": (),
    "sensor.camera.rgb": (
        *(
            "image_size_x",
            "image_size_y",
            "fov",
            "lens_k",
            "lens_kcube",
            "lens_circle_falloff",
            "sensor_tick",
        ),
    ),
    "sensor.lidar.ray_cast": (
        *("channels", "range", "points_per_second", "rotation_frequency", "upper_fov", "lower_fov"),
        *("dropoff_general_rate", "dropoff_intensity_limit", "dropoff_zero_intensity", "noise_stddev"),
        "sensor_tick",
    ),
    "sensor.other.collision": (),
}


class Blueprint:
    def __init__(self, name: str) -> None:
        self.id, self.attributes = name, dict[str, str]()

    def has_attribute(self, name: str) -> bool:
        return name in BLUEPRINTS[self.id]

    def set_attribute(self, name: str, value: str) -> None:
        assert isinstance(value, str)
        self.attributes[name] = value


class Library:
    def find(self, name: str) -> Blueprint:
        if name not in BLUEPRINTS:
            raise IndexError(f"blueprint '{name}' not found")
        return Blueprint(name)

    def filter(self, pattern: str) -> list[Blueprint]:
        return [Blueprint(name) for name in fnmatch.filter(BLUEPRINTS, pattern)]


class Actor:
    def __init__(self, carla: Any, number: int, thing: Blueprint, transform: Any) -> None:
        self.id, self.type_id, self.attributes = number, thing.id, thing.attributes
        self._carla, self._transform = carla, transform
        self.speed_mps, self.steer, self.force_mps2 = 0.0, 0.0, 0.0
        self.listeners: list[Any] = []
        self.stopped = False
        self.bounding_box = carla.BoundingBox(carla.Location(0, 0, 0.75), carla.Vector3D(2.446, 0.918, 0.745))

    def get_transform(self) -> Any:
        return self._transform

    def get_velocity(self) -> Any:
        ahead = self._transform.get_forward_vector()
        return self._carla.Vector3D(*(self.speed_mps * c for c in (ahead.x, ahead.y, ahead.z)))

    def apply_control(self, control: Any) -> None:
        assert isinstance(control, self._carla.VehicleControl)
        self.force_mps2 = WEAK * 4.0 * control.throttle - 8.0 * control.brake
        self.steer = control.steer

    def move(self) -> None:
        """In CARLA's left-handed axes: a positive steering raises the yaw."""
        drag = 0.2 if self.speed_mps > 0 else 0.0
        before = self.speed_mps
        self.speed_mps = max(0.0, before + (self.force_mps2 - drag) * STEP_S)
        way_m = 0.5 * (before + self.speed_mps) * STEP_S
        yaw = math.radians(self._transform.rotation.yaw)
        # The rear axle leads the way, 1.65 m behind the middle.
        turned = yaw + 0.278 * self.steer * way_m
        middle = self._transform.location
        x = middle.x - 1.64855 * math.cos(yaw) + way_m * math.cos(yaw) + 1.64855 * math.cos(turned)
        y = middle.y - 1.64855 * math.sin(yaw) + way_m * math.sin(yaw) + 1.64855 * math.sin(turned)
        rotation = self._carla.Rotation(0.0, math.degrees(turned), 0.0)
        self._transform = self._carla.Transform(self._carla.Location(x, y, 0.0), rotation)

    def listen(self, callback: Any) -> None:
        self.listeners.append(callback)

    def stop(self) -> None:
        self.stopped = True

    def start(self) -> None:
        self.started = True

    def set_autopilot(self, on: bool, port: int) -> None:
        self.autopilot = (on, port)

    def set_max_speed(self, speed_mps: float) -> None:
        self.max_speed_mps = speed_mps

    def go_to_location(self, place: Any) -> None:
        self.goal = place

    def measure(self, frame: int) -> Any:
        if self.type_id == "sensor.camera.rgb":
            width, height = int(self.attributes["image_size_x"]), int(self.attributes["image_size_y"])
            bgra = np.full((height, width, 4), frame % 256, dtype=np.uint8)
            return SimpleNamespace(frame=frame, width=width, height=height, raw_data=bgra.tobytes())
        points = np.array([[8.0, 2.0, -1.0, 0.5], [9.0, 0.0, 0.0, 0.1]], dtype=np.float32)
        return SimpleNamespace(
            frame=frame, channels=2, raw_data=points.tobytes(), get_point_count=lambda channel: 1
        )


class ActorList(list[Any]):
    def filter(self, pattern: str) -> "ActorList":
        return ActorList(actor for actor in self if fnmatch.fnmatch(actor.type_id, pattern))


class Light:
    """At one `carla.Waypoint`; `shows` is what it shows."""

    type_id = "traffic.traffic_light"
    attributes: dict[str, str] = {}  # noqa: RUF012

    def __init__(self, number: int, waypoint: Any, shows: Any) -> None:
        self.id, self._waypoint, self.shows = number, waypoint, shows

    def get_state(self) -> Any:
        return self.shows

    def get_stop_waypoints(self) -> list[Any]:
        return [self._waypoint]


class Traffic:
    def __init__(self) -> None:
        self.synchronous, self.seed = False, -1

    def get_port(self) -> int:
        return 8000

    def set_synchronous_mode(self, on: bool) -> None:
        self.synchronous = on

    def set_random_device_seed(self, seed: int) -> None:
        self.seed = seed


class MapOfServer:
    """A `carla.Map`; where vehicles may start only a server knows."""

    def __init__(self, town: Any) -> None:
        self._town = town

    def get_spawn_points(self) -> list[Any]:
        return [waypoint.transform for waypoint in self._town.generate_waypoints(15.0)]

    def get_waypoint(self, *where: Any, **kinds: Any) -> Any:
        return self._town.get_waypoint(*where, **kinds)


class World:
    def __init__(self, carla: Any, town: Any) -> None:
        self._carla, self._map, self.settings = carla, MapOfServer(town), carla.WorldSettings()
        self.frame, self.actors, self.furniture = 100, list[Actor](), list[Any]()
        self.full, self.mute, self.dead_at = False, False, math.inf
        self.weather: Any = None

    def get_settings(self) -> Any:
        settings = self._carla.WorldSettings()
        for name in ("synchronous_mode", "fixed_delta_seconds"):
            setattr(settings, name, getattr(self.settings, name))
        return settings

    def apply_settings(self, settings: Any) -> None:
        assert isinstance(settings, self._carla.WorldSettings)
        self.settings = settings

    def get_map(self) -> Any:
        return self._map

    def get_blueprint_library(self) -> Library:
        return Library()

    def get_actors(self) -> ActorList:
        return ActorList([*self.actors, *self.furniture])

    def set_weather(self, weather: Any) -> None:
        assert isinstance(weather, self._carla.WeatherParameters)
        self.weather = weather

    def set_pedestrians_seed(self, seed: int) -> None:
        self.people_seed = seed

    def reset_all_traffic_lights(self) -> None:
        pass

    def get_random_location_from_navigation(self) -> Any:
        return self._carla.Location(1.0, 2.0, 0.2)

    def try_spawn_actor(self, thing: Blueprint, transform: Any, attach_to: Any = None) -> Actor | None:
        assert isinstance(transform, self._carla.Transform)
        if self.full and attach_to is None:
            return None
        self.actors.append(Actor(self._carla, len(self.actors) + 1000, thing, transform))
        return self.actors[-1]

    def tick(self) -> int:
        self.frame += 1
        if self.frame >= self.dead_at:
            raise RuntimeError("time-out of 20000ms while waiting for the simulator")
        for actor in self.actors:
            if actor.type_id.startswith("vehicle."):
                actor.move()
        for actor in self.actors:
            if actor.listeners and actor.type_id != "sensor.other.collision" and not self.mute:
                for callback in actor.listeners:
                    callback(actor.measure(self.frame))
        return self.frame

    def collide(self, other: Any) -> None:
        """What the next tick's collision sensor reports."""
        for actor in self.actors:
            if actor.type_id == "sensor.other.collision":
                for callback in actor.listeners:
                    callback(SimpleNamespace(frame=self.frame, other_actor=other))

    @property
    def hero(self) -> Actor:
        return next(actor for actor in self.actors if actor.attributes.get("role_name") == "hero")


class Client:
    def __init__(self, world: World) -> None:
        self.world, self.traffic = world, Traffic()

    def get_available_maps(self) -> list[str]:
        return ["/Game/Carla/Maps/Town01", "/Game/Carla/Maps/Town02"]

    def load_world(self, town: str) -> World:
        assert town == "Town02"
        return self.world

    def get_trafficmanager(self, port: int) -> Traffic:
        return self.traffic

    def apply_batch(self, commands: list[Any]) -> None:
        gone = {command.actor_id for command in commands}
        assert gone <= {actor.id for actor in self.world.actors}
        self.world.actors = [actor for actor in self.world.actors if actor.id not in gone]


def lat_lon(x: float, y: float, lat_0: float, lon_0: float) -> tuple[float, float]:
    """As the leaderboard writes a place of CARLA's left-handed world (so y is mirrored) by satellite."""
    radius_m, scale = 6378137.0, math.cos(math.radians(lat_0))
    east_m = scale * math.radians(lon_0) * radius_m + x
    north_m = scale * radius_m * math.log(math.tan(math.radians(90.0 + lat_0) / 2)) + y
    lon = math.degrees(east_m / (radius_m * scale))
    lat = math.degrees(2 * math.atan(math.exp(north_m / (radius_m * scale)))) - 90.0
    return lat, lon
