"""A session on CARLA's server: the world runs in step with the client, and is restored at the end."""

import atexit
import contextlib
import logging
import queue
from typing import Any

from foredrive.driving.dynamics import STEP_S
from foredrive.errors import InputError
from foredrive.integrations.carla.client import answering, import_carla
from foredrive.integrations.carla.frames import CarlaPose

TRAFFIC_PORT = 8000
_log = logging.getLogger(__name__)


class CarlaSession:
    """One town in synchronous mode at 20 Hz, with all actors that were added to it.

    `close` destroys the actors and returns the server to asynchronous mode, even after errors. Each of these
    steps is tried even if others fail. The session is a context manager that calls `close`.

    Args:
        client: a `carla.Client`.
        town: name of the town. The town is loaded anew, so that lights and props are in their initial state.
        seed: seed of the traffic.

    Raises:
        InputError: the server has no such town, or does not answer.
    """

    def __init__(self, client: Any, town: str, seed: int, traffic_port: int = TRAFFIC_PORT) -> None:
        self._client, self._carla, self._end = client, import_carla(), contextlib.ExitStack()
        self._actors: list[Any] = []
        atexit.register(self.close)
        try:
            with answering(f"loading {town}"):
                self.world = _load(client, town)
                self.traffic = client.get_trafficmanager(traffic_port)
                self._go_synchronous(seed)
        except BaseException:
            self.close()
            raise

    def _go_synchronous(self, seed: int) -> None:
        settings = self.world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, STEP_S
        self._end.callback(self._go_asynchronous)
        self.world.apply_settings(settings)
        self._end.callback(self.traffic.set_synchronous_mode, False)
        self.traffic.set_synchronous_mode(True)
        self.traffic.set_random_device_seed(seed)
        self.world.set_pedestrians_seed(seed)
        self._end.callback(self._destroy)

    def _go_asynchronous(self) -> None:
        settings = self.world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = False, None
        self.world.apply_settings(settings)

    def _destroy(self) -> None:
        actors, self._actors = self._actors, []
        with contextlib.ExitStack() as stack:
            commands = [self._carla.command.DestroyActor(actor.id) for actor in reversed(actors)]
            stack.callback(self._client.apply_batch, commands)
            for actor in actors:
                if actor.type_id.startswith(("sensor.", "controller.")):
                    stack.callback(actor.stop)

    def spawn(
        self, blueprint: str, pose: CarlaPose, attributes: dict[str, str], attach_to: Any = None
    ) -> Any | None:
        """Add an actor to the world. Return None if there is no room for it.

        Raises:
            InputError: the server has no such blueprint, or the blueprint has no such attribute.
        """
        try:
            thing = self.world.get_blueprint_library().find(blueprint)
        except IndexError:
            raise InputError(f"the CARLA server has no blueprint {blueprint!r}") from None
        for name, value in attributes.items():
            if not thing.has_attribute(name):
                raise InputError(f"CARLA's blueprint {blueprint!r} has no attribute {name!r}")
            thing.set_attribute(name, value)
        actor = self.world.try_spawn_actor(thing, self.transform(pose), attach_to=attach_to)
        if actor is not None:
            self._actors.append(actor)
        return actor

    def transform(self, pose: CarlaPose) -> Any:
        """Convert a pose to a `carla.Transform`."""
        x, y, z, roll, pitch, yaw = pose
        location, rotation = self._carla.Location(x, y, z), self._carla.Rotation(pitch, yaw, roll)
        return self._carla.Transform(location, rotation)

    def tick(self) -> int:
        """Run one simulation step. Return the number of the new frame."""
        with answering("a simulation step"):
            return int(self.world.tick())

    def close(self) -> None:
        """Destroy the added actors and return the server to asynchronous mode. Warn if the server is gone."""
        atexit.unregister(self.close)
        try:
            self._end.close()
        except RuntimeError as error:
            _log.warning("CARLA's server is not left as it was found: %s", " ".join(str(error).split()))

    def __enter__(self) -> "CarlaSession":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class SensorQueue:
    """Queue that passes the data of one sensor from the client's thread to ours.

    Args:
        sensor: a `carla.Sensor`, which listens from now on.
        name: name of the sensor, for errors.
    """

    def __init__(self, sensor: Any, name: str) -> None:
        self._name, self._sent = name, queue.SimpleQueue[Any]()
        sensor.listen(self._sent.put)

    def at(self, frame: int, timeout_s: float) -> Any:
        """Return the data of a frame. Data of earlier frames is dropped.

        Raises:
            InputError: the data does not arrive in time.
        """
        with contextlib.suppress(queue.Empty):
            while True:
                data = self._sent.get(timeout=timeout_s)
                if data.frame == frame:
                    return data
                if data.frame > frame:
                    break
        raise InputError(f"CARLA's sensor {self._name} has sent nothing for frame {frame} in {timeout_s:g} s")

    def all(self) -> list[Any]:
        """Return all data that has arrived since the last call."""
        values = []
        with contextlib.suppress(queue.Empty):
            while True:
                values.append(self._sent.get_nowait())
        return values


def _load(client: Any, town: str) -> Any:
    names = [name.rsplit("/", 1)[-1] for name in client.get_available_maps()]
    if town not in names:
        raise InputError(f"the CARLA server has no {town}; it has {', '.join(sorted(names))}")
    return client.load_world(town)
