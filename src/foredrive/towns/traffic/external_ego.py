"""Vehicle 0 driven from outside, as the other road users see it.

Where it follows a lane, the others treat it as a normal vehicle with its path ahead. In addition, it has a
shadow on every other lane that its outline blocks. A shadow is a vehicle that drives along that lane as fast
as vehicle 0 does. All rules hold for shadows as for vehicles, so no special rules are needed for a vehicle
that stands across lanes, drives against them or appears suddenly.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.scene import Category
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.lane_index import LaneIndex
from foredrive.towns.traffic.paths import towards
from foredrive.towns.traffic.scripted_actors import ScriptedActor
from foredrive.towns.traffic.vehicles import BEHIND, WINDOW, Vehicles, empty_slots, path_starts

LANE_REACH_M = 2.5
MAX_HEADING_ERROR_RAD = np.deg2rad(60.0)
HEADING_ERROR_M = 2.0
"""Lateral distance that counts as much as a heading error of one radian, m."""
KNOWN_LANE_BONUS_M = 0.6
"""Bonus for lanes of the known path, m: they count as this much closer."""
KNOWN_CONNECTOR_BONUS_M, MAX_HEADING_ERROR_INSIDE_RAD = 3.0, np.deg2rad(90.0)
"""The same bonus (m) and the maximum heading error (rad) inside junctions. They are larger, so that a vehicle
that turns in wide is not assigned another path."""
PATH_LOOK = 4
HALF_CORRIDOR_M = 1.3
"""Half the width of the corridor around the middle of a lane, m. Anything inside it blocks the lane."""
LOOKAHEAD_S = 1.0
"""Time ahead, s, at which drivers see that a vehicle comes into their lane (outside of junctions)."""
SCRIPTED_LOOKAHEAD_S = (1.0, 2.0, 3.0)
"""The same for people on foot or on a bicycle, s."""
MIN_MOVING_MPS = 0.5
HARD_BRAKING_MPS2, REACTION_S = 6.0, 0.2
"""Deceleration and reaction time of hard braking. A vehicle that cannot stop for a line even so is considered
to enter the junction, whatever the light shows."""
APPROACH_MPS, APPROACH_S = 1.0, 4.0
"""Minimum speed and maximum time to the line at which vehicle 0 counts as approaching. The others yield only
to an approaching vehicle or to one that waits at the line."""
AT_LINE_M, TURN_S, MISSED_TURN_S = 4.0, 8.0, 4.0
"""Maximum distance to the line at which vehicle 0 counts as waiting, m, and the length of its turn, s. It may
not want to go: if it does not use its turn within `TURN_S`, it gets the next only after `MISSED_TURN_S`."""
DANGER_S = 1.5
DANGER_MARGIN_M = 0.5
"""Time (s) and lateral margin (m) of the region around a vehicle that people do not step into."""


@dataclass(frozen=True)
class EgoPose:
    """The present pose and motion of vehicle 0."""

    axle_xyz: Float64[np.ndarray, "3"]
    """Ground point below the rear axle, world frame, m."""
    yaw_rad: float
    speed_mps: float
    turn_radps: float = 0.0
    """Turn rate, rad/s, positive to the left."""

    @property
    def forward(self) -> Float64[np.ndarray, "3"]:
        """Return the unit heading, seen from above."""
        return np.array([np.cos(self.yaw_rad), np.sin(self.yaw_rad), 0.0])

    def extrapolated(self, seconds: float) -> "EgoPose":
        """Return the pose after a time (s) at this speed and turn rate."""
        # Motion along a chord at half the turned angle: second order in time
        turned = self.turn_radps * seconds
        along = self.yaw_rad + 0.5 * turned
        moved = self.speed_mps * seconds * np.array([np.cos(along), np.sin(along), 0.0])
        return dataclasses.replace(self, axle_xyz=self.axle_xyz + moved, yaw_rad=self.yaw_rad + turned)


@dataclass(frozen=True)
class PerceivedEgo:
    """Vehicle 0 as the other road users see it."""

    ego: EgoPose
    vehicles: Vehicles
    """All vehicles, then the shadows. Vehicle 0 is on the lane it follows, and not active if it follows
    none."""
    count: int
    """Number of vehicles without the shadows."""
    route_passed: int
    may_request: Bool[np.ndarray, "M"]
    """Vehicles whose requests for right of way count. Those of vehicle 0 count only while it approaches or
    waits at the line."""

    @property
    def centre_m(self) -> Float64[np.ndarray, "3"]:
        """Return the middle of vehicle 0 on the ground, m."""
        return self.ego.axle_xyz + self.vehicles.axle_to_centre_m[0] * self.ego.forward

    def is_endangered(self, xy: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Return for each point whether vehicle 0 is there or soon will be."""
        forward, offset = self.ego.forward[:2], xy - self.centre_m[:2]
        # Coordinates of the points in the frame of vehicle 0: ahead and aside
        aside = np.abs(offset @ [-forward[1], forward[0]])
        half_length, half_width = 0.5 * self.vehicles.size_lwh[0, :2]
        # The region reaches `DANGER_S` ahead, and not behind the rear bumper
        ahead = half_length + DANGER_MARGIN_M + DANGER_S * self.ego.speed_mps
        along = offset @ forward
        return np.asarray((along > -half_length) & (along < ahead) & (aside < half_width + DANGER_MARGIN_M))

    def without_shadows(self, moved: Vehicles) -> Vehicles:
        """Return the vehicles without the shadows after all have moved.

        Vehicle 0 stays in its slot, wherever it is.
        """
        return _with_ego(moved.rows(slice(self.count)), active=True)


def perceive_ego(
    graph: LaneGraph,
    near: LaneIndex,
    vehicles: Vehicles,
    ego: EgoPose,
    route: Int[np.ndarray, "R"],
    route_passed: int,
    time_s: float,
) -> PerceivedEgo:
    """Return the view of vehicle 0 at the pose to which it has been driven from outside.

    Args:
        route: as in `TrafficState`. Off its route, vehicle 0 is assumed to go as straight as it can.
    """
    # Lanes are matched at the box centre, as the arc lengths of vehicles are
    centre = ego.axle_xyz + vehicles.axle_to_centre_m[0] * ego.forward
    # The lanes that it has driven towards so far are preferred, above all connectors within junctions
    route_lanes = vehicles.path[0, BEHIND : BEHIND + PATH_LOOK]
    lane_place = find_lane(
        near, centre, ego.yaw_rad, route_lanes, route_lanes[graph.junction[route_lanes] >= 0]
    )
    if lane_place is None:
        # Off all lanes: it is no vehicle of any lane, only its shadows remain
        placed = _with_ego(vehicles, active=False, speed_mps=0.0, granted=0)
    else:
        lane, s_m = lane_place
        route_passed, to_come = _remaining_route(graph, route, route_passed, lane)
        path, passed = _path_from(graph, vehicles.path[0], lane, to_come)
        placed = _with_ego(
            vehicles,
            path=path,
            s_m=min(s_m, float(graph.length_m[lane])),
            speed_mps=ego.speed_mps,
            acceleration_mps2=0.0,
            # Grants count lanes ahead, so lanes that it has left behind are subtracted
            granted=max(0, int(vehicles.granted[0]) - passed),
            has_stopped=bool(vehicles.has_stopped[0]) and passed == 0,
            shift_m=0.0,
        )
    # Shadows are not needed on the lanes behind, under and ahead of it on its own path
    own = placed.path[0, BEHIND - 1 : BEHIND + 2] if placed.active[0] else np.zeros(0, dtype=np.int64)
    beside = _shadows(near, graph, ego, placed.axle_to_centre_m[0], placed.size_lwh[0], own)
    with_shadows, may_request = _grant_committed(graph, placed.appended(beside), time_s)
    return PerceivedEgo(ego, with_shadows, len(vehicles.active), route_passed, may_request)


def _with_ego(vehicles: Vehicles, **changes: object) -> Vehicles:
    """Return the vehicles with other values for the first one."""
    values = {}
    for name, value in changes.items():
        values[name] = getattr(vehicles, name).copy()
        values[name][0] = value
    return dataclasses.replace(vehicles, **values)


def find_lane(
    near: LaneIndex,
    centre: Float64[np.ndarray, "3"],
    yaw_rad: float,
    route_lanes: Int[np.ndarray, "k"],
    inside: Int[np.ndarray, "j"],
) -> tuple[int, float] | None:
    """Find the lane that a vehicle follows and the arc length beside it.

    Return None if it follows no lane.

    Args:
        centre: the middle of the vehicle on the ground.
        known: lanes that it is likely to follow.
        inside: those of the known lanes that are in junctions.
    """
    samples = near.within(centre, LANE_REACH_M)
    # Difference of angles, wrapped to -π … π
    heading_error = np.abs((yaw_rad - near.heading[samples] + np.pi) % (2 * np.pi) - np.pi)
    surely = (near.lane[samples, None] == inside).any(axis=1)
    may = heading_error < np.where(surely, MAX_HEADING_ERROR_INSIDE_RAD, MAX_HEADING_ERROR_RAD)
    samples, heading_error, surely = samples[may], heading_error[may], surely[may]
    if not len(samples):
        return None
    # Cost of a sample: distance plus heading error in metres, minus the bonus for expected lanes
    offset = centre[:2] - near.xyz[samples, :2]
    cost = np.hypot(offset[:, 0], offset[:, 1]) + HEADING_ERROR_M * heading_error
    cost -= np.where(
        surely,
        KNOWN_CONNECTOR_BONUS_M,
        KNOWN_LANE_BONUS_M * (near.lane[samples, None] == route_lanes).any(axis=1),
    )
    best = int(np.argmin(cost))
    # Refine the arc length by the offset along the lane's heading
    along_m = float(offset[best] @ near.ahead[samples[best]])
    return int(near.lane[samples[best]]), max(0.0, float(near.along_m[samples[best]]) + along_m)


def _remaining_route(
    graph: LaneGraph, route: Int[np.ndarray, "R"], passed: int, lane: int
) -> tuple[int, Int[np.ndarray, "_"]]:
    """Return how many stretches of the route lie behind vehicle 0, and the stretches from the current one on.

    The second value is empty if it is off its route.
    """
    # All lanes side by side with the current one serve the same stretch of the route
    abreast = {lane}
    for side in graph.sides.lane:
        beside = int(side[lane])
        while beside >= 0 and beside not in abreast:
            abreast.add(beside)
            beside = int(side[beside])
    # Search from one stretch back (it may have been pushed back) to a few ahead
    for index in range(max(0, passed - 1), min(passed + PATH_LOOK, len(route))):
        if int(route[index]) in abreast:
            return index, route[index:]
    return passed, route[:0]


def _path_from(
    graph: LaneGraph, path: Int[np.ndarray, "W"], lane: int, to_come: Int[np.ndarray, "R"]
) -> tuple[Int[np.ndarray, "W"], int]:
    """Return the path of a vehicle that has come to a lane, and the number of lanes it has advanced."""
    # On the known path: shift its columns by the lanes passed
    ahead = np.flatnonzero(path[BEHIND:] == lane)
    passed = int(ahead[0]) if len(ahead) else WINDOW
    if len(ahead):
        path = np.append(path[passed:], np.full(passed, -1))
    else:
        # Elsewhere: a new path from this lane, backwards along the first predecessors
        path = np.full(WINDOW, -1)
        path[BEHIND] = lane
        for column in range(BEHIND - 1, -1, -1):
            path[column] = graph.predecessors[path[column + 1], 0] if path[column + 1] >= 0 else -1
    # Fill the unknown columns ahead: along the route, or as straight as possible
    for column in range(BEHIND + 1, WINDOW):
        before, stretch = int(path[column - 1]), column - BEHIND
        if path[column] >= 0 or before < 0 or graph.successor_count[before] == 0:
            continue
        options = graph.successors[before, : graph.successor_count[before]]
        straightest = int(options[np.argmin(np.abs(graph.turn_rad[options]))])
        on_route = stretch < len(to_come)
        path[column] = towards(graph, before, int(to_come[stretch]), straightest) if on_route else straightest
    return path, passed


def scripted_actor_shadows(graph: LaneGraph, near: LaneIndex, actors: Sequence[ScriptedActor]) -> Vehicles:
    """Return shadow vehicles on the lanes that moving scripted actors block or soon will block."""
    shadows, no_lanes = empty_slots(0), np.zeros(0, dtype=np.int64)
    for actor in actors:
        if actor.is_under_way:
            pose = EgoPose(actor.xyz, actor.yaw_rad, actor.speed_mps)
            size = actor.size_lwh
            shadows = shadows.appended(_shadows(near, graph, pose, 0.0, size, no_lanes, SCRIPTED_LOOKAHEAD_S))
    return shadows


def _shadows(
    near: LaneIndex,
    graph: LaneGraph,
    ego: EgoPose,
    axle_to_centre_m: float,
    size_lwh: Float64[np.ndarray, "3"],
    own: Int[np.ndarray, "k"],
    soon_s: tuple[float, ...] = (LOOKAHEAD_S,),
) -> Vehicles:
    """Return shadow vehicles on the lanes that a vehicle blocks, without its own lanes."""
    half = 0.5 * size_lwh[:2]
    rows: dict[int, tuple[float, float, float]] = {}
    times_s = (0.0, *soon_s) if ego.speed_mps > MIN_MOVING_MPS else (0.0,)
    # Now, and where it will be soon: drivers react to a vehicle that comes into their lane
    for time_s in times_s:
        then = ego.extrapolated(time_s)
        centre = then.axle_xyz + axle_to_centre_m * then.forward
        # Candidates: samples within the half diagonal of the box plus the corridor
        samples = near.within(centre, float(np.hypot(*half)) + HALF_CORRIDOR_M)
        lane = near.lane[samples]
        # Predictions count only outside of junctions, where rules of right of way apply instead
        wanted = (lane[:, None] != own).all(axis=1) & ((graph.junction[lane] < 0) if time_s else True)
        samples = samples[wanted]
        # Keep the samples whose corridor the outline really reaches
        samples = samples[_blocks_corridor(near, samples, centre, then.yaw_rad, half)]
        for here in np.unique(near.lane[samples]).tolist():
            # Samples are sorted by lane and arc length: the first and last bound the blocked stretch
            on_it = samples[near.lane[samples] == here]
            first, last = near.along_m[on_it[0]], near.along_m[on_it[-1]]
            # Speed along the lane: negative for a vehicle that drives against it
            mps = float(ego.speed_mps * np.cos(then.yaw_rad - near.heading[on_it[0]]))
            if here not in rows:  # placed where it would be now if it were in that lane already
                rows[here] = float(first) - mps * time_s, float(last) - mps * time_s, mps
    # Each shadow is a car of the length of the blocked stretch, in the middle of it
    one = empty_slots(len(rows))
    table = np.array(list(rows.values())).reshape(-1, 3)
    path = one.path.copy()
    path[:, BEHIND] = list(rows)
    # Blocked samples stand for half a step to either side
    margin = 0.5 * graph.step_m[path[:, BEHIND]]
    size = np.tile(size_lwh, (len(rows), 1))
    size[:, 0] = table[:, 1] - table[:, 0] + 2 * margin
    return dataclasses.replace(
        one,
        active=np.ones(len(rows), dtype=np.bool_),
        category=np.full(len(rows), int(Category.CAR)),
        size_lwh=size,
        path=path,
        s_m=0.5 * (table[:, 0] + table[:, 1]),
        speed_mps=table[:, 2],
    )


def _blocks_corridor(
    near: LaneIndex,
    samples: Int[np.ndarray, "n"],
    centre: Float64[np.ndarray, "3"],
    yaw_rad: float,
    half: Float64[np.ndarray, "2"],
) -> Bool[np.ndarray, "n"]:
    """Return for each sample whether an oriented box reaches into the lane's corridor.

    The line across the corridor is clipped by the box's two pairs of sides (Liang & Barsky 1984).
    """
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    R_box_world = np.array([[cos, sin], [-sin, cos]])
    # Sample positions and the direction across the lane, in the frame of the box
    local = (near.xyz[samples, :2] - centre[:2]) @ R_box_world.T
    ahead = near.ahead[samples]
    across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) @ R_box_world.T
    # Avoids a division by zero where the line is parallel to a side
    across = np.where(np.abs(across) < 1e-9, 1e-9, across)
    # Parameters (m along the line) at which it meets each pair of sides
    a, b = (-half - local) / across, (half - local) / across
    # Intersection of both spans with the corridor -w … w
    enters = np.minimum(a, b).max(axis=1).clip(-HALF_CORRIDOR_M)
    leaves = np.maximum(a, b).min(axis=1).clip(max=HALF_CORRIDOR_M)
    return np.asarray(enters <= leaves)


def _grant_committed(
    graph: LaneGraph, vehicles: Vehicles, time_s: float
) -> tuple[Vehicles, Bool[np.ndarray, "M"]]:
    """Grant vehicle 0 the junction that it drives through or can no longer stop for.

    Also return which vehicles may request right of way.
    """
    may_request = np.ones(len(vehicles.active), dtype=np.bool_)
    speed, path = float(vehicles.speed_mps[0]), vehicles.path[0]
    # The next contested lane: the current one if it is inside a junction already
    contested = graph.contested[path] & (path >= 0)
    inside = bool(contested[BEHIND])
    first = BEHIND + 1 + (0 if inside else int(np.argmax(contested[BEHIND + 1 :])))
    if not vehicles.active[0] or not contested[first]:
        return vehicles, may_request
    # Distance of the front bumper from the line
    gap_m = float(path_starts(graph, path[None])[0, first] - vehicles.front_m[0])
    comes = speed > APPROACH_MPS and gap_m < APPROACH_S * speed
    granted_s = float(vehicles.rank[0])  # time at which its last turn began; 0 if it has had none
    has_missed = granted_s > 0 and TURN_S <= time_s - granted_s < TURN_S + MISSED_TURN_S
    # Requests count while it approaches, or while it waits and has not just missed its turn
    may_request[0] = comes or (speed <= APPROACH_MPS and gap_m < AT_LINE_M and not has_missed)
    if not may_request[0]:
        return _with_ego(vehicles, granted=0), may_request
    # It is inside or cannot stop any more: grant all contested lanes that follow each other
    if inside or (comes and gap_m < speed**2 / (2 * HARD_BRAKING_MPS2) + REACTION_S * speed):
        end = first + int(np.argmin(np.append(contested[first:], False)))
        return _with_ego(vehicles, granted=end - 1 - BEHIND), may_request
    return vehicles, may_request
