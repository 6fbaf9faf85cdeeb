"""A rule-based agent: it follows the route by the intelligent driver model and gives way (`speed_rule`)."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float64

from foredrive.data.truth.affordances import PASSED_M, PathAhead, lead_of, occupied_by, path_ahead
from foredrive.driving.lane_rules import LEVEL_M
from foredrive.driving.simple_agents import plan_of
from foredrive.driving.speed_rule import FRONT_M, Obstacle, PathView, rule_progress, waypoints_along
from foredrive.driving.stop_signs import StopSigns
from foredrive.geometry.path_frame import along_path, path_headings
from foredrive.geometry.polylines import arc_lengths
from foredrive.scene import Boxes, Clip, Trajectory
from foredrive.scene.affordances import (
    CELL_M,
    LATER_DT_S,
    LIGHT_RANGE_M,
    TIMES,
    PathEstimate,
)
from foredrive.scene.traffic_light import LightState
from foredrive.towns.driving.town import TownSimulator
from foredrive.towns.driving.town_lanes import stop_lines
from foredrive.towns.map.loading import load_town_map

BESIDE_M = 1.75
"""Largest distance of a stop line from the path."""
PROBABLE = 0.5


class IdmAgent:
    """An `Agent` on the route's line that keeps its distance by the intelligent driver model.

    Args:
        path: returns the route ahead in an observation of a batch of one.
        view: returns what is on that route: the truth, or what is perceived.
    """

    def __init__(
        self, path: Callable[[Clip], PathAhead], view: Callable[[Clip, PathAhead], PathView]
    ) -> None:
        self._path, self._view = path, view

    def act(self, observation: Clip) -> Trajectory:
        """Return the plan for an observation of a batch of one."""
        clip, path = observation[0], self._path(observation)
        view = self._view(observation, path)
        along_m = rule_progress(path, float(clip.ego_speed_mps[clip.now]), view)
        return plan_of(torch.from_numpy(waypoints_along(path, along_m)).float()[None, None])


class TruePerception:
    """Reads what is on the route in one drive from the simulator. It remembers at which signs it has stood.

    Args:
        simulator: the town that is driven in.
    """

    def __init__(self, simulator: TownSimulator) -> None:
        self._simulator, self._signs = simulator, StopSigns()
        self._before_xy: Float64[np.ndarray, 2] | None = None

    def __call__(self, observation: Clip) -> PathEstimate:
        """Return the view of an observation of a batch of one as an estimate that is sure."""
        view = self.view(observation, self.path(observation))
        return PathEstimate(
            torch.eye(4)[[view.light]],
            torch.tensor([view.light_m]),
            torch.from_numpy(view.occupied).float()[None],
        )

    def path(self, observation: Clip) -> PathAhead:
        """Return the route ahead of an observation of a batch of one."""
        clip = observation[0]
        xyz = self._simulator.scenario.route_xyz
        T_world_ego = clip.T_world_ego[clip.now].numpy()
        return path_ahead(xyz, arc_lengths(xyz), self._simulator.done_m, T_world_ego, FRONT_M)

    def view(self, observation: Clip, path: PathAhead) -> PathView:
        """Return what is on a path: the state of its light, and boxes that go on at constant velocity."""
        clip = observation[0]
        T_world_ego = clip.T_world_ego[clip.now].numpy()
        states = self._simulator.traffic.zone_lights(self._simulator.state.decided.time_s)
        light, light_m = LightState.NONE, 0.0
        if (nearest := self._nearest(path, T_world_ego, states != LightState.NONE)) is not None:
            light, light_m = LightState(int(states[nearest[0]])), nearest[1]
        view = true_view(clip.boxes[clip.now], path, light, light_m)
        # A sign is a red light until the vehicle has stood at it and given way
        xy, before_xy = T_world_ego[:2, 3], self._before_xy
        self._before_xy = xy
        moved_m = 0.0 if before_xy is None else float(np.linalg.norm(xy - before_xy))
        sign = self._nearest(path, T_world_ego, None)
        sign_m, speed_mps = None if sign is None else sign[1], float(clip.ego_speed_mps[clip.now])
        stop_m = self._signs.update(sign_m, moved_m, speed_mps, view.occupied)
        stops = light in (LightState.RED, LightState.YELLOW)
        if stop_m is None or (stops and light_m < stop_m):
            return view
        return view._replace(light=LightState.RED, light_m=stop_m)

    def _nearest(
        self, path: PathAhead, T_world_ego: Float64[np.ndarray, "4 4"], lit: Bool[np.ndarray, "Z"] | None
    ) -> tuple[int, float] | None:
        """Return the stop zone and the distance of the next light that works, or of the next stop sign.

        Args:
            lit: stop zones whose lights work. None: signs are looked for.
        """
        lines = stop_lines(load_town_map(self._simulator.scenario.town))
        asked = lines.is_sign if lit is None else ~lines.is_sign & lit[lines.zone]
        # Stop lines into the ego frame, then to distance along and beside the path
        T_ego_world = np.linalg.inv(T_world_ego)
        xyz = lines.xyz @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
        ahead = lines.ahead @ T_ego_world[:2, :2].T
        along, left = along_path(torch.from_numpy(xyz[:, :2]).float(), path.xy, path.valid)
        heading = path_headings(along, path.xy, path.valid).numpy()
        # Gap from the front bumper, not from the rear axle
        gap_m = along.double().numpy() - path.front_m
        height_m = np.interp(along.numpy(), np.arange(len(path.z)), path.z)
        # Lines across this path, in its direction, ahead and on its level
        mine = asked & (left.abs().numpy() < BESIDE_M) & ((heading * ahead).sum(-1) > 0.5)
        mine &= (gap_m > -PASSED_M) & (gap_m < LIGHT_RANGE_M)
        mine &= np.abs(xyz[:, 2] - height_m) < LEVEL_M
        if not mine.any():
            return None
        row = int(np.where(mine, gap_m, np.inf).argmin())
        return int(lines.zone[row]), float(gap_m[row])


def true_view(boxes: Boxes, path: PathAhead, light: LightState, light_m: float) -> PathView:
    """Return the view of a path where boxes are known: they go on at constant velocity.

    Args:
        boxes: unbatched, in the frame of the path.
        path: the path.
        light, light_m: the next light and its distance.
    """
    # The nearest user in the path now gives gap and speed; the cells say what is in the path over time
    is_led, gap_m, speed_mps, _ = lead_of(boxes, path)
    t_s = LATER_DT_S * torch.arange(TIMES)
    moved = boxes.velocity.nan_to_num()[:, None] * t_s[:, None]
    occupied = occupied_by(
        boxes,
        boxes.centre[:, None, :2] + moved,
        boxes.yaw[:, None].expand(-1, TIMES),
        boxes.valid[:, None].expand(-1, TIMES),
        path,
    )
    lead = Obstacle(gap_m, max(speed_mps, 0.0)) if is_led else None
    return PathView(light, light_m, lead, occupied.any(0).numpy())


def estimated_view(estimate: PathEstimate) -> PathView:
    """Return the view of a path of an unbatched estimate."""
    occupied = (estimate.occupied >= PROBABLE).cpu().numpy()
    return PathView(
        LightState(int(estimate.light.argmax())), float(estimate.light_m), lead_in(occupied), occupied
    )


def lead_in(occupied: np.ndarray) -> Obstacle | None:
    """Return the first road user in the path now, its speed by the first occupied cell two seconds later."""
    if not occupied[0].any():
        return None
    # Speed from the shift of the first occupied cell within two seconds
    first, later = int(occupied[0].argmax()), round(2.0 / LATER_DT_S)
    moved = int(occupied[later].argmax()) - first if occupied[later].any() else 0
    return Obstacle(max(CELL_M * first + 0.25 * CELL_M, 0.3), max(CELL_M * moved / 2.0, 0.0))
