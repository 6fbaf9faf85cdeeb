"""A rule-based agent: it follows the route by the intelligent driver model."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.data.affordances import PathAhead, lead_of, path_ahead
from foredrive.geometry.path_frame import along_path, path_headings
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import Boxes, Category, Clip, Trajectory
from foredrive.scene.affordances import CROSSING_RANGE_M, LIGHT_RANGE_M, AffordanceEstimate
from foredrive.scene.traffic_light import LightState
from foredrive.simulation.dynamics import EGO
from foredrive.simulation.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.simulation.simple_agents import plan_of
from foredrive.simulation.town import TownSimulator
from foredrive.simulation.town_lanes import stop_lines
from foredrive.towns.map.town_map import load_town_map
from foredrive.towns.traffic.car_following import follow_acceleration, free_acceleration

DESIRED_MPS, ACCELERATION_MPS2, BRAKING_MPS2 = 8.0, 1.5, 2.5
STANDSTILL_M, TIME_GAP_S = 2.0, 1.2
"""Parameters of the model: a calm driver in town."""
LATERAL_MPS2 = 2.0
"""Bound of the lateral acceleration; it slows the vehicle before curves."""
LOOKS_M = 20.0
BESIDE_M, ENTERS_M, WALKS_S = 1.75, 1.7, 3.0
"""Largest distance of a stop line from the path; distance at which a person is on it, within this time."""
PROBABLE = 0.5
REJOINS_M = 8.0
STEPS_PER_FRAME = 5
FRONT_M = EGO.axle_to_centre_m + 0.5 * EGO.length_m


class Obstacle(NamedTuple):
    """Something to follow or to stop at."""

    gap_m: float
    """Distance from the front bumper along the path."""
    speed_mps: float


class IdmAgent:
    """An `Agent` on the route's line that keeps its distance by the intelligent driver model.

    It knows the route and its place on it. Lights, the lead vehicle and people come from the simulator or
    from `perceive`.

    Args:
        simulator: the town that it drives in.
        perceive: returns what is perceived in an observation of a batch of one; None reads the simulator.
    """

    def __init__(
        self, simulator: TownSimulator, perceive: Callable[[Clip], AffordanceEstimate] | None = None
    ) -> None:
        self._simulator, self._perceive = simulator, perceive

    def act(self, observation: Clip) -> Trajectory:
        """Return the plan for an observation of a batch of one."""
        clip = observation[0]
        xyz = self._simulator.scenario.route_xyz
        arc_m, T_world_ego = arc_lengths(xyz), clip.T_world_ego[clip.now].numpy()
        path = path_ahead(xyz, arc_m, self._simulator.done_m, T_world_ego, FRONT_M)
        if self._perceive is None:
            obstacles = self._known(clip.boxes[clip.now], path, T_world_ego)
        else:
            obstacles = _told(self._perceive(observation), path)
        along_m = drive_along(path, float(clip.ego_speed_mps[clip.now]), obstacles)
        return plan_of(torch.from_numpy(_waypoints(path, along_m)).float()[None, None])

    def _known(
        self, boxes: Boxes, path: PathAhead, T_world_ego: Float64[np.ndarray, "4 4"]
    ) -> list[Obstacle]:
        """Return the obstacles from the state of the simulator."""
        found = []
        there, gap_m, speed_mps, _ = lead_of(boxes, path)
        if there:
            found.append(Obstacle(gap_m, speed_mps))
        people = boxes[(boxes.category == int(Category.PEDESTRIAN)) & boxes.valid]
        found += _people(people.centre[:, :2], people.velocity.nan_to_num(), path)
        light, light_m = self._light(path, T_world_ego)
        return found + _stops(light, light_m)

    def _light(self, path: PathAhead, T_world_ego: Float64[np.ndarray, "4 4"]) -> tuple[LightState, float]:
        """Return state and distance of the next light on the path."""
        lines = stop_lines(load_town_map(self._simulator.scenario.town))
        states = self._simulator.traffic.zone_lights(self._simulator.state.decided.time_s)
        T_ego_world = np.linalg.inv(T_world_ego)
        at = lines.xyz @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
        ahead = lines.ahead @ T_ego_world[:2, :2].T
        along, left = along_path(torch.from_numpy(at[:, :2]).float(), path.xy, path.valid)
        heading = path_headings(along, path.xy, path.valid).numpy()
        gap_m = along.double().numpy() - path.front_m
        mine = (left.abs().numpy() < BESIDE_M) & ((heading * ahead).sum(-1) > 0.5) & ~lines.is_sign
        mine &= (gap_m > -0.5) & (gap_m < LIGHT_RANGE_M) & (states[lines.zone] != LightState.NONE)
        if not mine.any():
            return LightState.NONE, 0.0
        row = int(np.where(mine, gap_m, np.inf).argmin())
        return LightState(int(states[lines.zone[row]])), float(gap_m[row])


def drive_along(path: PathAhead, speed_mps: float, obstacles: list[Obstacle]) -> Float64[np.ndarray, "T"]:
    """Return the distance along the path at each waypoint, by the IDM behind the nearest of all obstacles."""
    dt_s = FRAME_DT_S / STEPS_PER_FRAME
    desired = np.array([_curve_speed(path)])
    limits = (np.array([ACCELERATION_MPS2]), np.array([BRAKING_MPS2]))
    along_m, speed, found = 0.0, speed_mps, []
    for step in range(HORIZON_STEPS * STEPS_PER_FRAME):
        v = np.array([speed])
        free = free_acceleration(v, desired, *limits)
        wanted = float(free[0])
        for obstacle in obstacles:
            gap = obstacle.gap_m + obstacle.speed_mps * step * dt_s - along_m
            behind = follow_acceleration(
                free,
                v,
                v - obstacle.speed_mps,
                np.array([gap]),
                np.array([STANDSTILL_M]),
                np.array([TIME_GAP_S]),
                *limits,
            )
            wanted = min(wanted, float(behind[0]))
        after = max(0.0, speed + max(wanted, -8.0) * dt_s)
        along_m, speed = along_m + 0.5 * (speed + after) * dt_s, after
        if (step + 1) % STEPS_PER_FRAME == 0:
            found.append(along_m)
    return np.array(found)


def _told(estimate: AffordanceEstimate, path: PathAhead) -> list[Obstacle]:
    """Return the obstacles of an estimate, a batch of one."""
    found = []
    if float(estimate.lead[0]) >= PROBABLE:
        found.append(Obstacle(max(float(estimate.lead_m[0]), 0.0), max(float(estimate.lead_mps[0]), 0.0)))
    probable = estimate.crossing_xy[0][estimate.crossing[0] >= PROBABLE]
    found += _people(probable, torch.zeros_like(probable), path, within_m=6.0)
    return found + _stops(LightState(int(estimate.light[0].argmax())), float(estimate.light_m[0]))


def _people(
    xy: torch.Tensor, velocity: torch.Tensor, path: PathAhead, within_m: float = ENTERS_M
) -> list[Obstacle]:
    """Return obstacles for people who are or will be on the path, at constant velocity."""
    found = []
    for t_s in np.arange(0.0, WALKS_S + 0.1, 0.5):
        along, left = along_path(xy + t_s * velocity, path.xy, path.valid)
        gap_m = along - path.front_m
        on_path = (left.abs() < within_m) & (gap_m > 0) & (gap_m < CROSSING_RANGE_M)
        found += [Obstacle(float(gap), 0.0) for gap in gap_m[on_path]]
    return found


def _stops(light: LightState, light_m: float) -> list[Obstacle]:
    """Return the obstacle of a light: red stops, yellow too where there is room to brake."""
    room = light_m > DESIRED_MPS**2 / (2 * BRAKING_MPS2)
    if light is LightState.RED or (light is LightState.YELLOW and room):
        return [Obstacle(light_m + 1.0, 0.0)]  # the model stops `STANDSTILL_M` before it
    return []


def _curve_speed(path: PathAhead) -> float:
    """Return the speed at which the lateral acceleration of the next metres is bearable."""
    count = min(int(path.valid.sum()), int(LOOKS_M))
    if count < 8:
        return DESIRED_MPS
    xy = path.xy[:count].numpy()
    heading = np.unwrap(np.arctan2(*(xy[4:] - xy[:-4]).T[::-1]))
    bend = float(np.abs(np.diff(heading)).max()) if len(heading) > 1 else 0.0
    return float(min(DESIRED_MPS, np.sqrt(LATERAL_MPS2 / max(bend, 1e-6))))


def _waypoints(path: PathAhead, along_m: Float64[np.ndarray, "T"]) -> Float64[np.ndarray, "T 2"]:
    """Return points of the path, which the vehicle rejoins over `REJOINS_M`."""
    xy = path.xy[path.valid].double().numpy()
    if len(xy) < 2:
        return np.zeros((len(along_m), 2))
    points = points_at(xy, np.arange(len(xy), dtype=np.float64), along_m)
    return np.asarray(points - np.exp(-along_m / REJOINS_M)[:, None] * xy[0])
