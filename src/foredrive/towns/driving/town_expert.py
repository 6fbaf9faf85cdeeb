"""Privileged expert for towns: it knows the states and the rules of all road users.

Twice a second it simulates the town ahead with itself as one of the road users. The simulation uses the same
rules that drive in recordings (`towns.traffic`): right of way, lights, gaps, and lane changes for its route.
Scenarios happen in the simulation as well. The simulated motion of the ego vehicle is the plan. The expert is
the upper bound for all agents that learn from recordings.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.driving.collisions import Box, RoadUsers, touched
from foredrive.driving.dynamics import EGO
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import Clip, Trajectory
from foredrive.towns.driving.road_users import road_users
from foredrive.towns.driving.town import DECISION_S, PredictedState, TownSimulator, TownState
from foredrive.towns.traffic.external_ego import EgoPose
from foredrive.towns.traffic.leaders import find_leaders
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.traffic.vehicles import path_starts

EVERY, STEPS = 2, 15
"""A waypoint lies every `EVERY` decisions, `STEPS` in all: 3 s."""
SETS_OFF_S, SETS_OFF_MPS, AT_LIGHT_M = 2.5, 1.0, 3.0
"""A vehicle slower than `SETS_OFF_MPS` and nearer to a stop line than `AT_LIGHT_M` needs `SETS_OFF_S` to
cross it. If the light changes earlier, it waits for the next green."""
BRAKES_MPS2 = (3.0, 6.0)
"""Decelerations with which the expert brakes if its path leads into a road user, m/s². It prefers the
gentler one."""
NEAR_M = 0.2
"""Minimum distance of road users from the vehicle's outline on its path, m."""
REJOINS_M = 5.0
"""A lateral offset from the simulated path decays to 1/e over this distance, m."""
HALT_MPS = 0.3
"""A slower vehicle counts as standing, m/s."""
EDGES_MPS, EDGES_MPS2 = 2.5, 1.0
"""Speed and acceleration with which the expert moves slowly along the route, if there is no room for a
lane change that the route needs."""
CLEAR_M = 0.5
"""Minimum distance of road users from the vehicle's outline in this case, m."""
LOOK_M = 2.0
"""Look-ahead distance on the route from which the heading is taken in this case, m."""
LOST_AHEAD_M, LOST_BESIDE_M = 3.0, 1.5
"""If the vehicle is further than this from its planned position, m (longitudinal, lateral), the plan
restarts from its current lane."""


class TownExpert:
    """An `Agent` for one simulator. A planned lane change is continued from plan to plan.

    Args:
        simulator: simulator in which the expert drives; its state is all that the expert uses.
    """

    def __init__(self, simulator: TownSimulator) -> None:
        self._simulator = simulator
        self._imagined: list[PredictedState] = []
        self._planned: tuple[TownState, Trajectory] | None = None

    def act(self, observation: Clip) -> Trajectory:
        """Return the plan from the simulator's current state. The observation is not used."""
        return self.plan()

    def plan(self) -> Trajectory:
        """Return the plan from the simulator's current state.

        Repeated calls in one state give the same plan.
        """
        if self._planned is None or self._planned[0] is not self._simulator.state:
            self._planned = self._simulator.state, self._plan()
        return self._planned[1]

    def _plan(self) -> Trajectory:
        simulator, traffic = self._simulator, self._simulator.traffic
        here, now = simulator.driven, simulator.predict_now()
        now = dataclasses.replace(now, traffic=self._gone_on(traffic, now.traffic, here))
        self._imagined = [now]
        # At a line or a red light it stays where it is
        if traffic.waits_at_line(now.traffic) or _is_too_late(traffic, now.traffic):
            return _in_ego_frame(np.tile(here.axle_xyz[:2], (STEPS, 1)), here)
        for _ in range(EVERY * STEPS):
            self._imagined.append(simulator.predict_next(self._imagined[-1]))
        # It would stand for ever before a lane change without room: push in slowly along the route
        halts = self._imagined[-1].traffic.vehicles.speed_mps[0] < HALT_MPS
        if halts and traffic.lacks_change_room(now.traffic):
            return _in_ego_frame(self._edged_over(traffic, here)[EVERY - 1 :: EVERY], here)
        path = np.stack([traffic.poses(imagined.traffic).axle_xyz[0, :2] for imagined in self._imagined])
        path = self._not_into_anybody(traffic, _rejoined(path, here.axle_xyz[:2]), here)
        # Every second point of the simulated path, without the present one
        return _in_ego_frame(path[EVERY::EVERY], here)

    def _not_into_anybody(
        self, traffic: Traffic, path: Float64[np.ndarray, "K 2"], here: EgoPose
    ) -> Float64[np.ndarray, "K 2"]:
        """Return the simulated path, or a path with braking if it would lead into a road user."""
        v, graph = self._imagined[0].traffic.vehicles, traffic.lanes
        leader = find_leaders(graph, v, path_starts(graph, v.path)).leader
        behind = v.track_id[leader == 0]  # vehicles behind take care themselves
        # The others in each simulated step, without those that follow this vehicle
        users = [road_users(traffic, imagined.traffic).without(behind) for imagined in self._imagined]
        arc_m = arc_lengths(path)
        t_s = DECISION_S * np.arange(len(path))
        # Distances over time: the simulated motion first, then braking at two rates
        options = [arc_m]
        for brakes_mps2 in BRAKES_MPS2:
            # v t - b t² / 2 until standstill; the vehicle does not leave the end of its path
            till_s = np.minimum(t_s, here.speed_mps / brakes_mps2)
            options.append(np.minimum(here.speed_mps * till_s - 0.5 * brakes_mps2 * till_s**2, arc_m[-1]))
        free = (way_m for way_m in options if _is_free(path, arc_m, way_m, users, here))
        best_m = next(free, options[-1])
        return points_at(path, arc_m, best_m)

    def _edged_over(self, traffic: Traffic, here: EgoPose) -> Float64[np.ndarray, "T 2"]:
        """Return points that move slowly along the route, one per simulated step.

        The motion stops as soon as a road user comes near.
        """
        now, xyz = self._imagined[0], self._simulator.scenario.route_xyz
        arc_m = arc_lengths(xyz[:, :2])
        max_m = traffic.to_light_m(now.traffic)
        way_m, speed, points = 0.0, here.speed_mps, [here.axle_xyz[:2]]
        for imagined in self._imagined[1:]:
            speed = min(speed + EDGES_MPS2 * DECISION_S, EDGES_MPS)
            way_m = min(way_m + speed * DECISION_S, max(max_m, way_m))
            # Position on the route and a point ahead, from which the heading is taken
            along_m = now.progress.done_m + way_m + np.array([0.0, LOOK_M])
            (x, ahead_x), (y, ahead_y) = (np.interp(along_m, arc_m, axis) for axis in xyz.T[:2])
            yaw = math.atan2(ahead_y - y, ahead_x - x)
            middle = np.array([x, y, here.axle_xyz[2]])
            middle[:2] += EGO.axle_to_centre_m * np.array([math.cos(yaw), math.sin(yaw)])
            half = 0.5 * np.array([EGO.length_m, EGO.width_m]) + CLEAR_M
            others = road_users(traffic, imagined.traffic)
            # Stop at the first contact; wait in place if the other one moves
            met = touched(Box(middle, yaw, half), others)
            if (np.hypot(*others.velocity_mps[met].T) > HALT_MPS).any():
                points = points[:1]  # the moving road user goes first
            if met.any():
                break
            points.append(np.array([x, y]))
        points += [points[-1]] * (len(self._imagined) - len(points))
        return np.stack(points[1:])

    def _gone_on(self, traffic: Traffic, state: TrafficState, here: EgoPose) -> TrafficState:
        """Keep the planned path and lane change, if the vehicle is where they lead."""
        # The imagined state of this very time from the last plan, if there is one
        states = (imagined.traffic for imagined in self._imagined)
        planned_state = next((s for s in states if abs(s.time_s - state.time_s) < 0.5 * DECISION_S), None)
        if planned_state is None:
            return state
        poses = traffic.poses(planned_state)
        # Offset of the real vehicle from that state, along and across its heading
        offset = here.axle_xyz[:2] - poses.axle_xyz[0, :2]
        ahead_m = float(offset @ here.forward[:2])
        beside_m = float(offset @ [-here.forward[1], here.forward[0]])
        if abs(ahead_m) > LOST_AHEAD_M or abs(beside_m) > LOST_BESIDE_M:
            return state
        # Take the path and lane change from the plan; speed and right of way are those of the real vehicle
        first = np.array([0])
        wanted, real = planned_state.vehicles.rows(first), state.vehicles.rows(first)
        row = dataclasses.replace(
            wanted.moved(np.array([ahead_m])),
            speed_mps=real.speed_mps,
            granted=real.granted,
            requested_s=real.requested_s,
            rank=real.rank,
            has_stopped=real.has_stopped,
        )
        return dataclasses.replace(state, vehicles=state.vehicles.replace_rows(first, row))


def _is_free(
    path: Float64[np.ndarray, "K 2"],
    arc_m: Float64[np.ndarray, "K"],
    way_m: Float64[np.ndarray, "K"],
    users: Sequence[RoadUsers],
    here: EgoPose,
) -> bool:
    """Return whether the vehicle touches no road user on a path, given its distance along it at each step."""
    half, yaw = 0.5 * np.array([EGO.length_m, EGO.width_m]) + NEAR_M, here.yaw_rad
    for at_m, others in zip(way_m.tolist(), users, strict=True):
        # Heading from the last metre of the path; at standstill the last heading stays
        axle, before = (points_at(path, arc_m, m) for m in (at_m, max(at_m - 1.0, 0.0)))
        if np.hypot(*(axle - before)) > 0.5:
            yaw = math.atan2(*(axle - before)[::-1])
        forward = np.array([math.cos(yaw), math.sin(yaw)])
        middle = np.append(axle + EGO.axle_to_centre_m * forward, here.axle_xyz[2])
        if touched(Box(middle, yaw, half), others).any():
            return False
    return True


def _is_too_late(traffic: Traffic, state: TrafficState) -> bool:
    """Return whether the vehicle is at rest, or nearly, at a light that is not green long enough to cross."""
    to_light_m = min(traffic.to_light_m(state, in_s) for in_s in (0.0, SETS_OFF_S))
    return bool(state.vehicles.speed_mps[0] < SETS_OFF_MPS and to_light_m < AT_LIGHT_M)


def _rejoined(path: Float64[np.ndarray, "K 2"], here: Float64[np.ndarray, "2"]) -> Float64[np.ndarray, "K 2"]:
    """Return a path that begins at the vehicle and gradually approaches the simulated one."""
    way_m = arc_lengths(path)
    # The lateral error decays exponentially along the path
    return path + np.exp(-way_m / REJOINS_M)[:, None] * (here - path[0])


def _in_ego_frame(xy_world: Float64[np.ndarray, "T 2"], here: EgoPose) -> Trajectory:
    cos, sin = math.cos(here.yaw_rad), math.sin(here.yaw_rad)
    # Row vectors times the rotation to the ego frame
    xy = (xy_world - here.axle_xyz[:2]) @ np.array([[cos, -sin], [sin, cos]])
    points = torch.tensor(xy, dtype=torch.float32)[None, None]
    flat = points[..., 0]
    return Trajectory(
        xy=points,
        yaw=torch.zeros_like(flat),
        valid=torch.ones_like(flat, dtype=torch.bool),
        log_prob=torch.zeros(1, 1),
        dt_s=EVERY * DECISION_S,
    )
