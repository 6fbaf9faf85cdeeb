"""A drive through a town as a Gymnasium environment."""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from foredrive.driving.dynamics import EGO
from foredrive.driving.route_sets import load_route_set
from foredrive.driving.scores import FACTOR_1_0, Ending, InfractionKind, timeout_s
from foredrive.errors import InputError
from foredrive.scene import Clip, Control, Event
from foredrive.scene.affordances import CELLS, LIGHT_RANGE_M, TIMES
from foredrive.scene.clip import ROUTE_M
from foredrive.sensors.rigs import FRONT_TELE, RigPlan, camera_rig
from foredrive.towns.driving.idm_agent import TruePerception
from foredrive.towns.driving.routes import DriveRoute, snap_route
from foredrive.towns.driving.town import TRAFFIC_STEPS, TownScenario, TownSimulator, grow
from foredrive.towns.map.names import TEST_TOWNS
from foredrive.towns.scenarios.places import scenarios_on
from foredrive.towns.sensing.capture import SensorSuite

BOXES, BOX_NUMBERS = 16, 8
"""Road users in an observation, the nearest ones, and the numbers of each."""
FAR = 200.0
NUMBERS = {
    "ego": (-50.0, 50.0, (3,)),
    "route": (-FAR, FAR, (len(ROUTE_M), 2)),
    "light": (0.0, 1.0, (4,)),
    "light_m": (-FAR, LIGHT_RANGE_M, (1,)),
    "occupied": (0.0, 1.0, (TIMES, CELLS)),
    "boxes": (-FAR, FAR, (BOXES, BOX_NUMBERS)),
}
"""Bounds and shapes of the parts of an observation but images."""
PENALTY = 100.0
"""Cost of an infraction with factor 0, in metres of the route."""
COLLISIONS = (
    InfractionKind.COLLISION_PEDESTRIAN,
    InfractionKind.COLLISION_VEHICLE,
    InfractionKind.COLLISION_STATIC,
)


class TownEnv(gymnasium.Env[Any, np.ndarray]):
    """The ego vehicle on routes through a town, in its traffic.

    **Action**: acceleration and steering in -1 to 1. -1 is full braking or the end stop to the right.

    **Observation**: `ego` (speed m/s, acceleration m/s², steering angle rad), `route` (points ahead in the
    ego frame, m; 0 beyond its end), `light` (none, red, yellow or green, as a 1 among 0), `light_m` (distance
    of its stop line, or of a stop sign's, m), `occupied` (cells of the route over the next four seconds, as
    `Affordances.occupied`), `boxes` (the nearest road users: x, y, cosine and sine of the heading, length,
    width, velocity in x and y; 0 where there are none), and with `cameras` `images`.

    **Reward**: metres driven along the route, less `PENALTY` · (1 - factor) for each infraction that
    leaderboard 1.0 counts. An episode ends at the end of the route, 30 m beside it, after 180 s without
    moving, or at a collision; it is truncated when the time of the leaderboard is up. `info["events"]` are
    the events of a step, `info["completion"]` is the share of the route.

    Args:
        town: name of a town.
        routes: name of a route set or path of a route file; by default the town's own short routes.
        cameras: cameras that render at each step. None: no images.
        skip: steps of the simulation (20 Hz) for each action, a multiple of two: traffic decides at 10 Hz.
        worlds: seeds of buildings and traffic of which each episode draws one. A change takes seconds.
        scenarios: whether others provoke the vehicle on its way.
        stops_at_collision: whether a collision ends the episode.

    Raises:
        InputError: the set has no route in this town, or `skip` is odd.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  # as Gymnasium has it

    def __init__(
        self,
        town: str = "Town05",
        routes: str | None = None,
        cameras: RigPlan | None = None,
        skip: int = 2,
        worlds: int = 1,
        scenarios: bool = True,
        stops_at_collision: bool = True,
        render_mode: str | None = None,
    ) -> None:
        name = routes or ("town05-short" if town in TEST_TOWNS else "training-short")
        self._routes = [route for route in load_route_set(name) if route.town == town]
        if not self._routes:
            raise InputError(f"{name} has no route in {town}: name another set with routes=")
        if skip < 1 or skip % TRAFFIC_STEPS:
            raise InputError(f"skip must be a multiple of {TRAFFIC_STEPS}, got {skip}")
        self._skip, self._worlds, self._scenarios = skip, worlds, scenarios
        self._stops_at_collision, self.render_mode = stops_at_collision, render_mode
        shown = cameras or (FRONT_TELE if render_mode else None)
        self._sensors = None if shown is None else SensorSuite(camera_rig(plan=shown), None)
        self._with_images = cameras is not None
        self._snapped: dict[str, DriveRoute] = {}
        self._simulator = TownSimulator()
        self.action_space = spaces.Box(-1.0, 1.0, (2,))
        parts: dict[str, spaces.Space[Any]] = {
            name: spaces.Box(np.float32(low), np.float32(high), shape)
            for name, (low, high, shape) in NUMBERS.items()
        }
        if cameras is not None:
            shape = (len(cameras.cameras), *cameras.image_hw, 3)
            parts["images"] = spaces.Box(0, 255, shape, np.uint8)
        self.observation_space = spaces.Dict(parts)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin a route, drawn at random or `options["route"]` by its id."""
        super().reset(seed=seed)
        ids = [route.id for route in self._routes]
        wanted = (options or {}).get("route", ids[int(self.np_random.integers(len(ids)))])
        if wanted not in ids:
            raise InputError(f"no route {wanted}; there are {', '.join(ids)}")
        if wanted not in self._snapped:
            self._snapped[wanted] = snap_route(self._routes[ids.index(wanted)])
        route, world = self._snapped[wanted], int(self.np_random.integers(self._worlds))
        provoking = scenarios_on(route, grow(route.town, world), world) if self._scenarios else ()
        self._simulator.reset(
            TownScenario(
                town=route.town,
                route_xyz=route.xyz,
                seed=world,
                sensors=self._sensors,
                past_frames=0,
                limit_s=timeout_s(route.length_m),
                lanes=route.lanes,
                scenarios=provoking,
            )
        )
        self._true = TruePerception(self._simulator)
        return self._observation(self._simulator.now()), {"route": wanted, "world": world, "completion": 0.0}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Drive on for `skip` steps, or until the drive ends."""
        throttle, wheel = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0).tolist()
        strength = EGO.max_acceleration_mps2 if throttle > 0 else EGO.max_braking_mps2
        control = Control(throttle * strength, wheel * EGO.max_steering_rad)
        before_m, events = self._simulator.done_m, list[Event]()
        for _ in range(self._skip):
            done = self._simulator.step(control)
            events += done.events
            if done.done:
                break
        costs = [1 - FACTOR_1_0[InfractionKind(event.kind)] for event in events if event.kind in FACTOR_1_0]
        reward = self._simulator.done_m - before_m - PENALTY * sum(costs)
        ended = self._simulator.state.ended
        collided = self._stops_at_collision and any(event.kind in COLLISIONS for event in events)
        info = {"events": events, "completion": self._simulator.progress().completion}
        truncated = ended == Ending.TIMEOUT and not collided
        terminated = collided or (ended is not None and not truncated)
        return self._observation(self._simulator.now()), float(reward), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Return the image of the first camera, if `render_mode` is "rgb_array"."""
        if self.render_mode is None:
            return None
        return np.asarray(self._now.images[self._now.now, 0].permute(1, 2, 0))

    def _observation(self, clip: Clip) -> dict[str, np.ndarray]:
        self._now, ego = clip, self._simulator.ego()
        path = self._true.path(clip[None])
        view = self._true.view(clip[None], path)
        observation = {
            "ego": np.array([ego.speed_mps, ego.acceleration_mps2, ego.steering_rad], np.float32),
            "route": torch.where(clip.route_valid[:, None], clip.route_xy, 0.0).float().numpy(),
            "light": np.eye(4, dtype=np.float32)[int(view.light)],
            "light_m": np.array([view.light_m], np.float32),
            "occupied": view.occupied.astype(np.float32),
            "boxes": self._nearest(clip),
        }
        observation = {
            name: value.clip(np.float32(NUMBERS[name][0]), np.float32(NUMBERS[name][1]))
            for name, value in observation.items()
        }
        if self._with_images:
            observation["images"] = clip.images[clip.now].permute(0, 2, 3, 1).numpy()
        return observation

    def _nearest(self, clip: Clip) -> np.ndarray:
        boxes = clip.boxes[clip.now]
        boxes = boxes[boxes.valid]
        boxes = boxes[boxes.centre[:, :2].norm(dim=-1).argsort()[:BOXES]]
        rows = np.zeros((BOXES, BOX_NUMBERS), np.float32)
        heading = torch.stack([boxes.yaw.cos(), boxes.yaw.sin()], dim=-1)
        columns = (boxes.centre[:, :2], heading, boxes.size_lwh[:, :2], boxes.velocity.nan_to_num())
        rows[: len(boxes.yaw)] = torch.cat(columns, dim=-1).numpy()
        return rows
