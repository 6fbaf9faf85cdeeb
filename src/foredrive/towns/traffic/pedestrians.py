"""People on foot: they walk randomly over walkways, wait for a gap in the traffic, and have priority while
they cross."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.scene.traffic_light import LightState
from foredrive.towns.traffic.leaders import LOOKAHEAD_M, motion_arrays
from foredrive.towns.traffic.slots import Slots
from foredrive.towns.traffic.vehicles import BEHIND, WINDOW, Vehicles
from foredrive.towns.traffic.walkways import WalkGraph

MAX_CATCH_UP = 1.3
"""Maximum speed where people cut the corner between two walks, as a multiple of their walking speed."""
ACCEPTED_BRAKING_MPS2 = 2.0
REACTION_S = 1.0
MARGIN_M = 1.0
YIELD_BRAKING_MPS2, EMERGENCY_BRAKING_MPS2 = 3.0, 4.0
"""Maximum decelerations with which drivers stop for people, m/s²: for people who approach the lane (after the
reaction time `YIELD_S`), and for people in the lane. If drivers would have to brake harder than the first
value, approaching people wait."""
YIELD_S = 0.5
IN_THE_WAY_M = 0.3
ALONG_CROSSING_M = 4.0
SLOW_MPS = 3.0
SPARE_S = 2.0
"""Time margin with which drivers pass before people reach their lane, s."""
AT_LANE_M = 0.5
BEYOND_LIGHT_M = 8.0
"""Maximum distance of a crossing behind the line of a light, m, for the crossing to depend on that light."""
PATIENCE_S = 25.0
"""Waiting time after which people walk elsewhere, s."""
STOP_EARLY_S = 0.4
"""Time, s, by which people stop early before they would step in front of a vehicle that is driven from
outside."""

DangerTest = Callable[[Float64[np.ndarray, "n 2"]], Bool[np.ndarray, "n"]]


@dataclass(frozen=True)
class Pedestrians(Slots):
    """N pedestrian slots."""

    size_lwh: Float64[np.ndarray, "N 3"]
    walking_mps: Float64[np.ndarray, "N"]
    lateral: Float64[np.ndarray, "N"]
    """Lateral position to the right of a walk's middle, as a fraction (0 to 1) of the half width."""
    walk: Int[np.ndarray, "N"]
    s_m: Float64[np.ndarray, "N"]
    direction: Int[np.ndarray, "N"]
    """Direction of walking: 1 along the walk, -1 against it."""
    next_walk: Int[np.ndarray, "N"]
    waited_s: Float64[np.ndarray, "N"]
    xyz: Float64[np.ndarray, "N 3"]
    """Position of the feet, m."""
    velocity_mps: Float64[np.ndarray, "N 3"]
    yaw: Float64[np.ndarray, "N"]


def empty_pedestrians(count: int) -> Pedestrians:
    """Return `count` empty slots."""
    values = {field.name: np.zeros(count) for field in dataclasses.fields(Pedestrians)}
    values["active"] = np.zeros(count, dtype=np.bool_)
    for name in ("track_id", "style", "walk", "direction", "next_walk"):
        values[name] = np.zeros(count, dtype=np.int64)
    for name in ("size_lwh", "xyz", "velocity_mps"):
        values[name] = np.zeros((count, 3))
    return Pedestrians(**values)


def draw_people(
    graph: WalkGraph,
    rng: np.random.Generator,
    track_ids: Int[np.ndarray, "k"],
    walk: Int[np.ndarray, "k"],
    s_m: Float64[np.ndarray, "k"],
) -> Pedestrians:
    """Draw k people who stand on walks."""
    count = len(track_ids)
    height = np.clip(rng.normal(1.7, 0.1, count), 1.3, 1.95)
    size = np.stack([rng.uniform(0.4, 0.6, count), rng.uniform(0.45, 0.65, count), height], axis=1)
    # The height is normally distributed and clipped
    direction = rng.choice([-1, 1], count)
    people = dataclasses.replace(
        empty_pedestrians(count),
        active=np.ones(count, dtype=np.bool_),
        track_id=track_ids,
        style=rng.integers(0, 2**31, count),
        size_lwh=size,
        walking_mps=np.clip(rng.normal(1.35, 0.2, count), 0.8, 1.9),
        lateral=rng.uniform(0.0, 1.0, count),
        walk=walk,
        s_m=s_m,
        direction=direction,
        next_walk=_choose_next(graph, walk, direction, rng.random(count)),
    )
    xyz = _target_xyz(graph, people)
    ahead = _target_xyz(graph, dataclasses.replace(people, s_m=s_m + 0.1 * direction)) - xyz
    return dataclasses.replace(people, xyz=xyz, yaw=np.arctan2(ahead[:, 1], ahead[:, 0]))


def step_pedestrians(
    graph: WalkGraph,
    people: Pedestrians,
    vehicles: Vehicles,
    starts_m: Float64[np.ndarray, "N W"],
    light: Int[np.ndarray, "L"],
    dt_s: float,
    rng: np.random.Generator,
    danger: DangerTest | None = None,
) -> Pedestrians:
    """Return the people one time step later.

    Args:
        light: the light at the start of each lane.
        danger: states for points, seen from above, whether people must not step there. People who are already
            in danger walk on.
    """
    if not len(people.active) or not len(graph.length_m):
        return people
    # Everyone wants to walk on; the following tests hold some of them back
    s = people.s_m + people.direction * people.walking_mps * dt_s
    s = np.where(_walks_into_vehicle(graph, people, vehicles, starts_m), people.s_m, s)
    # Do not step into the region around the vehicle that is driven from outside
    if danger is not None:
        soon = dataclasses.replace(people, s_m=s + people.direction * people.walking_mps * STOP_EARLY_S)
        waits = danger(_target_xyz(graph, soon)[:, :2]) & ~danger(people.xyz[:, :2])
        s = np.where(waits, people.s_m, s)
    # Distance beyond the end of the walk (negative: still on it)
    over = np.maximum(-s, s - graph.length_m[people.walk])
    leaving = people.active & (over >= 0)
    wants_to_cross = leaving & graph.is_crossing[people.next_walk]
    # Before a crossing people need a light or a gap in the traffic; after a while they choose another way
    blocked = wants_to_cross & ~_may_cross(graph, people.next_walk, wants_to_cross, vehicles, starts_m, light)
    impatient = blocked & (people.waited_s > PATIENCE_S)
    leaving &= ~blocked
    # The place where the walk ends in their direction, and the walk that they enter there
    place = graph.ends[people.walk, (people.direction > 0).astype(np.int64)]
    entry = np.where(leaving, people.next_walk, people.walk)
    at_start = graph.ends[entry, 0] == place
    # The end that touches the place is the start of the new walk; at a dead end they turn round
    turned = leaving & (entry == people.walk)
    direction = np.where(
        turned, -people.direction, np.where(leaving, np.where(at_start, 1, -1), people.direction)
    )
    # Continue by the distance that is left over, from the end at which they enter
    begun = np.where(direction > 0, over, graph.length_m[entry] - over)
    s = np.where(leaving, begun, np.clip(s, 0.0, graph.length_m[entry]))
    chosen = _choose_next(graph, entry, direction, rng.random(len(s)))
    moved = dataclasses.replace(
        people,
        walk=entry,
        s_m=s,
        direction=direction,
        # Who leaves needs the walk after the next; who is impatient draws another one
        next_walk=np.where(leaving | impatient, chosen, people.next_walk),
        waited_s=np.where(blocked & ~impatient, people.waited_s + dt_s, 0.0),
    )
    return _step_to_target(graph, moved, dt_s)


def _step_to_target(graph: WalkGraph, people: Pedestrians, dt_s: float) -> Pedestrians:
    # Feet follow the target point at a limited speed, so that corners are cut and not jumped
    to_go = _target_xyz(graph, people) - people.xyz
    distance = np.linalg.norm(to_go[:, :2], axis=1)
    reach = MAX_CATCH_UP * people.walking_mps * dt_s
    step = to_go * np.minimum(1.0, reach / distance.clip(1e-9))[:, None]
    step[~people.active] = 0.0
    moving = np.linalg.norm(step[:, :2], axis=1) > 0.1 * dt_s
    return dataclasses.replace(
        people,
        xyz=people.xyz + step,
        velocity_mps=step / dt_s,
        yaw=np.where(moving, np.arctan2(step[:, 1], step[:, 0]), people.yaw),
    )


def _target_xyz(graph: WalkGraph, people: Pedestrians) -> Float64[np.ndarray, "N 3"]:
    """Return the positions where people want to walk: to the right of the middle, in their direction."""
    # People keep to the right of their own direction
    offset = people.direction * people.lateral * graph.half_width_m[people.walk]
    middle = graph.position(people.walk, people.s_m)
    return middle + offset[:, None] * graph.right_of(people.walk, people.s_m)


def _choose_next(
    graph: WalkGraph,
    walk: Int[np.ndarray, "n"],
    direction: Int[np.ndarray, "n"],
    u: Float64[np.ndarray, "n"],
) -> Int[np.ndarray, "n"]:
    """Choose a walk that leaves the place ahead.

    It is the walk on which people arrive only if there is no other.
    """
    options = graph.incident[graph.ends[walk, (direction > 0).astype(np.int64)]]
    allowed = (options >= 0) & (options != walk[:, None])
    allowed[~allowed.any(axis=1), 0] = True  # dead end: turn back
    # The u-th allowed option
    pick = (u * allowed.sum(axis=1)).astype(np.int64)
    column = np.argmax(np.cumsum(allowed, axis=1) > pick[:, None], axis=1)
    return options[np.arange(len(walk)), column]


def crossing_gap(
    graph: WalkGraph, people: Pedestrians, vehicles: Vehicles, starts_m: Float64[np.ndarray, "N W"]
) -> Float64[np.ndarray, "N"]:
    """Return the gap from each front bumper to the crossing where it has to wait for people, m (infinite:
    none)."""
    if not len(graph.lane) or not people.active.any():
        return np.full(len(vehicles.active), np.inf)
    # Passings are sorted by lane, which the kernel uses for binary search
    passing = (graph.lane, graph.crossing, graph.lane_span_m, graph.walk_span_m)
    walking = np.flatnonzero(people.active & graph.is_crossing[people.walk])
    crossers = (
        people.walk[walking],
        people.s_m[walking],
        people.direction[walking],
        people.walking_mps[walking],
    )
    return _crossing_gap(motion_arrays(vehicles, starts_m), passing, crossers)


@numba.njit(cache=True)
@no_type_check
def _crossing_gap(motion, passing, crossers):
    lanes, crossings, lane_span, walk_span = passing
    walk, s, direction, pace = crossers
    gap = np.full(len(motion.active), np.inf)
    for i in range(len(motion.active)):
        if not motion.active[i]:
            continue
        speed, length = motion.speed_mps[i], motion.front_m[i] - motion.rear_m[i]
        # Distances at which braking for a person in the lane, or for
        # one who approaches, is no longer possible
        too_late = speed**2 / (2 * EMERGENCY_BRAKING_MPS2)
        too_sudden = speed**2 / (2 * YIELD_BRAKING_MPS2) + YIELD_S * speed
        for k in range(BEHIND, WINDOW):
            # Distances are from the front bumper: start is the way to the beginning of the lane
            lane, start = motion.path[i, k], motion.starts_m[i, k] - motion.front_m[i]
            if lane < 0 or start > LOOKAHEAD_M:
                break
            # All places where a crossing meets this lane
            for m in range(np.searchsorted(lanes, lane), np.searchsorted(lanes, lane + 1)):
                to_go = start + lane_span[m, 0]
                # Too late, already on it, or farther than what the vehicle stops for anyway
                if to_go < too_late or to_go < IN_THE_WAY_M or to_go >= gap[i]:
                    continue
                # Time until the rear has left the crossing, at least at walking pace
                cleared_s = (to_go + length + ALONG_CROSSING_M) / max(speed, SLOW_MPS)
                for p in range(len(walk)):
                    # Way of the person to the strip that vehicles use, and to its
                    # far side, in the walking direction
                    near, far = walk_span[m, 0] - s[p], walk_span[m, 1] - s[p]
                    if direction[p] < 0:
                        near, far = -far, -near
                    # In the strip already, or there before the vehicle has passed with some time to spare
                    comes = near <= 0 or (to_go >= too_sudden and near < pace[p] * (cleared_s + SPARE_S))
                    if walk[p] == crossings[m] and far > 0 and comes:
                        gap[i] = to_go
    return gap


def _may_cross(
    graph: WalkGraph,
    walk: Int[np.ndarray, "n"],
    asked: Bool[np.ndarray, "n"],
    vehicles: Vehicles,
    starts_m: Float64[np.ndarray, "N W"],
    light: Int[np.ndarray, "L"],
) -> Bool[np.ndarray, "n"]:
    """Return whether no light is green or yellow for the crossed lanes, and every vehicle can stop or has
    passed."""
    may = np.ones(len(walk), dtype=np.bool_)
    # Lanes whose light is green or yellow close the crossings right behind their line
    moving = light[graph.lane] > LightState.RED
    released = np.unique(graph.crossing[moving & (graph.lane_span_m[:, 0] < BEYOND_LIGHT_M)])
    for i in np.flatnonzero(asked):
        may[i] = walk[i] not in released
        for m in np.flatnonzero((graph.crossing == walk[i]) & may[i]):
            # Every vehicle whose path leads over the crossing, wherever the lane is on its path
            on_lane = vehicles.active[:, None] & (vehicles.path == graph.lane[m])
            to_go = starts_m + graph.lane_span_m[m, 0] - vehicles.front_m[:, None]
            passed = starts_m + graph.lane_span_m[m, 1] < vehicles.rear_m[:, None]
            speed = vehicles.speed_mps[:, None]
            # Distance to stop comfortably after the reaction time
            needed = speed**2 / (2 * ACCEPTED_BRAKING_MPS2) + REACTION_S * speed + IN_THE_WAY_M
            may[i] &= not (on_lane & ~passed & (to_go < needed + MARGIN_M * (speed > 0.1))).any()
    return may


def _walks_into_vehicle(
    graph: WalkGraph, people: Pedestrians, vehicles: Vehicles, starts_m: Float64[np.ndarray, "N W"]
) -> Bool[np.ndarray, "K"]:
    """Return which people are about to step in front of a vehicle that stands on the crossing or cannot
    stop."""
    blocked = np.zeros(len(people.active), dtype=np.bool_)
    for i in np.flatnonzero(people.active & graph.is_crossing[people.walk]):
        # Way to each strip of the crossing: only strips just ahead count
        ahead = people.direction[i] * (graph.walk_span_m - people.s_m[i])
        about = (graph.crossing == people.walk[i]) & (ahead.min(axis=1) > 0) & (ahead.min(axis=1) < AT_LANE_M)
        for m in np.flatnonzero(about):
            on_lane = vehicles.active[:, None] & (vehicles.path == graph.lane[m])
            to_go = starts_m + graph.lane_span_m[m, 0] - vehicles.front_m[:, None]
            passed = starts_m + graph.lane_span_m[m, 1] < vehicles.rear_m[:, None]
            speed = vehicles.speed_mps[:, None]
            # The driver could not stop any more: wait at the edge of the lane
            too_sudden = speed**2 / (2 * YIELD_BRAKING_MPS2) + YIELD_S * speed
            blocked[i] |= bool((on_lane & ~passed & (to_go < np.maximum(too_sudden, IN_THE_WAY_M))).any())
    return blocked
