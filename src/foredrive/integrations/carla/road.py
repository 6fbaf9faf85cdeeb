"""Lights, stop signs and lanes of a CARLA world, checked with the rules of `lane_rules`."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, Int

from foredrive.driving.lane_rules import (
    LINE_MARGIN_M,
    OUTSIDE_BY_M,
    WRONG_WAY_RAD,
    RuleState,
    StopLines,
    body_middle,
    lines_run,
    way_driven,
)
from foredrive.integrations.carla.client import import_carla
from foredrive.integrations.carla.frames import matrix_of
from foredrive.scene import BicycleState, Event
from foredrive.scene.traffic_light import LightState


class CarlaLaneRules:
    """Checks the rules for one drive in a CARLA world.

    Only the client's data is used. A light's lines are its `get_stop_waypoints()`. A stop sign's line lies
    across the lane at its trigger volume. The lane is the one nearest to the vehicle's middle.

    Args:
        world: a `carla.World`.
    """

    def __init__(self, world: Any) -> None:
        carla = import_carla()
        self._map = world.get_map()
        self._location, self._lane_type = carla.Location, carla.LaneType
        states = carla.TrafficLightState
        self._shows = {
            states.Red: LightState.RED,
            states.Yellow: LightState.YELLOW,
            states.Green: LightState.GREEN,
        }
        actors = world.get_actors()
        self._lights: list[Any] = list(actors.filter("traffic.traffic_light*"))
        signs = list(actors.filter("traffic.stop*"))
        stops = [(i, wp) for i, light in enumerate(self._lights) for wp in light.get_stop_waypoints()]
        for i, sign in enumerate(signs, start=len(self._lights)):
            middle = sign.get_transform().transform(sign.trigger_volume.location)
            stops.append((i, self._map.get_waypoint(middle)))
        self._lines = lines_at(stops, len(self._lights))
        self._signs = len(signs)

    def lights(self) -> Int[np.ndarray, "Z"]:
        """Return the current `LightState` of each light. The stop signs come after the lights, with NONE."""
        shown = [self._shows.get(light.get_state(), LightState.NONE) for light in self._lights]
        return np.array([*shown, *[LightState.NONE] * self._signs], dtype=np.int64)

    def check(
        self, before: BicycleState, after: BicycleState, z_m: float, state: RuleState, t_s: float
    ) -> tuple[list[Event], RuleState]:
        """Return the events of one step and the updated rule state."""
        events, stopped_at = lines_run(self._lines, before, after, z_m, self.lights(), state.stopped_at, t_s)
        outside = self.is_outside(np.append(body_middle(after), z_m), after.yaw_rad)
        more, state = way_driven(state, before, after, outside, t_s)
        return events + more, dataclasses.replace(state, stopped_at=stopped_at)

    def is_outside(self, xyz: Float64[np.ndarray, "3"], yaw_rad: float) -> bool:
        """Return whether a vehicle is outside of all lanes, or drives against the direction of its lane."""
        x, y, z = xyz.tolist()
        kinds = self._lane_type.Driving | self._lane_type.Parking
        lane = self._map.get_waypoint(self._location(x, -y, z), lane_type=kinds)
        T = matrix_of(lane.transform)
        forward = T[:2, 0] / np.linalg.norm(T[:2, 0])
        aside_m = float(np.linalg.norm(xyz[:2] - T[:2, 3]))
        if aside_m - 0.5 * lane.lane_width > OUTSIDE_BY_M:
            return True
        if lane.is_junction or aside_m > 0.5 * lane.lane_width or lane.lane_type != self._lane_type.Driving:
            return False
        turned = math.remainder(yaw_rad - math.atan2(forward[1], forward[0]), 2 * math.pi)
        return bool(abs(turned) > WRONG_WAY_RAD)


def lines_at(waypoints: Sequence[tuple[int, Any]], lights: int) -> StopLines:
    """Return the stop lines across lanes.

    Args:
        waypoints: index of a light or sign, and a `carla.Waypoint` on its line.
        lights: number of lights; indices from there on are signs.
    """
    T = np.array([matrix_of(waypoint.transform) for _, waypoint in waypoints]).reshape(-1, 4, 4)
    index = np.array([i for i, _ in waypoints], dtype=np.int64)
    ahead = T[:, :2, 0]
    return StopLines(
        zone=index,
        is_sign=index >= lights,
        xyz=T[:, :3, 3],
        ahead=ahead / np.linalg.norm(ahead, axis=1, keepdims=True),
        half_width_m=0.5 * np.array([wp.lane_width for _, wp in waypoints], dtype=float) + LINE_MARGIN_M,
    )
