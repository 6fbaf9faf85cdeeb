"""Sub-scores of the EPDMS: multipliers NC, DAC, DDC, TLC, and of the weighted ones EP, TTC and LK."""

import enum
import math
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float64

from foredrive.driving.epdms.world import STEP_S, EgoBody, EgoMotion, Roads, Surroundings

STOPPED_EGO_MPS, STOPPED_TRACK_MPS, TTC_STOPPED_MPS = 0.05, 0.05, 0.005
TTC_STEPS = (0, 3, 6, 9)
"""Steps ahead to which the ego vehicle is moved at constant velocity, within 1 s."""
DIRECTION_S, COMPLIES_M, VIOLATES_M = 1.0, 2.0, 6.0
"""Time over which driving against the traffic is summed, s; less than `COMPLIES_M` costs nothing, and less
than `VIOLATES_M` half."""
ASIDE_M, ASIDE_S = 0.5, 2.0
"""Lane keeping fails if the vehicle is further than `ASIDE_M` from the centreline for `ASIDE_S` on end."""
FAR_ENOUGH_M = 5.0
"""A reference that comes less far than this asks for no progress, m."""
AHEAD_RAD, BEHIND_RAD = math.radians(30.0), math.radians(150.0)


class Hit(enum.Enum):
    """Kinds of collisions (nuPlan's)."""

    STOPPED_EGO = enum.auto()
    STOPPED_TRACK = enum.auto()
    REAR = enum.auto()
    FRONT = enum.auto()
    LATERAL = enum.auto()


@dataclass(frozen=True, eq=False)
class EgoAreas:
    """Where the ego vehicle is at each step."""

    multiple_lanes: Bool[np.ndarray, "T"]
    """Corners are in several lanes, and no lane holds all four."""
    off_road: Bool[np.ndarray, "T"]
    """At least one corner is outside of the drivable area."""
    oncoming: Bool[np.ndarray, "T"]
    """The middle is in no lane of the route."""


def ego_areas(ego: EgoMotion, body: EgoBody, roads: Roads) -> EgoAreas:
    """Return where the ego vehicle is at each step."""
    # Corners in lanes, middle on the route, and corners in the drivable area, for all steps at once
    corners, centres = ego.corners(body), ego.centres(body)
    steps = len(corners)
    flat = corners.reshape(-1, 2).T
    inside = np.array([shapely.contains_xy(lane, *flat) for lane in roads.lanes]).reshape(-1, steps, 4)
    route = [lane for lane, on_route in zip(roads.lanes, roads.on_route, strict=True) if on_route]
    on_route = np.array([shapely.contains_xy(lane, *centres.T) for lane in route]).reshape(-1, steps)
    # Several lanes are touched, and none holds all four corners
    touched = inside.any(axis=2).sum(axis=0) > 1
    whole = (inside.sum(axis=2) == 4).any(axis=0)
    drivable = shapely.contains_xy(roads.drivable, *flat).reshape(steps, 4)
    return EgoAreas(touched & ~whole, ~drivable.all(axis=1), np.asarray(~on_route.any(axis=0)))


def no_at_fault_collision(ego: EgoMotion, body: EgoBody, areas: EgoAreas, others: Surroundings) -> float:
    """Return NC: 1, 0 for a collision at fault with a road user, 0.5 with another object.

    At fault are impacts into what stands, at the front, and at the side of a vehicle that is in several lanes
    or off the road. An object that was hit without fault is not looked at again.
    """
    score, forgiven = 1.0, set[int]()
    for step, corners in enumerate(ego.corners(body)):
        outline = shapely.Polygon(corners)
        for row, other in enumerate(others.outlines[step]):
            if other is None or row in forgiven or not outline.intersects(other):
                continue
            # What stands is judged first, then the side of the impact
            hit = _kind(ego, step, corners, other, others.stopped(row, STOPPED_TRACK_MPS))
            leaves = bool(areas.multiple_lanes[step] or areas.off_road[step])
            # At fault: front, standing objects, and sides while off the lane
            if hit in (Hit.FRONT, Hit.STOPPED_TRACK) or (leaves and hit is Hit.LATERAL):
                score = min(score, 0.0 if others.moves_by_itself[row] else 0.5)
            else:
                forgiven.add(row)
    return score


def _kind(
    ego: EgoMotion, step: int, corners: Float64[np.ndarray, "4 2"], other: shapely.Polygon, stands: bool
) -> Hit:
    if ego.speed_mps[step] <= STOPPED_EGO_MPS:
        return Hit.STOPPED_EGO
    if stands:
        return Hit.STOPPED_TRACK
    if _angle_rad(ego, step, other) > BEHIND_RAD:
        return Hit.REAR
    bumper = shapely.LineString([corners[0], corners[3]])
    return Hit.FRONT if bumper.intersects(other) else Hit.LATERAL


def _angle_rad(ego: EgoMotion, step: int, other: shapely.Polygon) -> float:
    """Return the angle between the heading and the direction from the rear axle to an object's middle."""
    away = np.array(other.centroid.coords[0]) - ego.xy_m[step]
    forward = np.array([math.cos(ego.yaw_rad[step]), math.sin(ego.yaw_rad[step])])
    return math.acos(float(np.clip(away @ forward / max(np.linalg.norm(away), 1e-9), -1.0, 1.0)))


def drivable_area_compliance(areas: EgoAreas) -> float:
    """Return DAC: 1 if all corners stay in the drivable area, else 0."""
    return float(not areas.off_road.any())


def driving_direction_compliance(ego: EgoMotion, body: EgoBody, areas: EgoAreas, roads: Roads) -> float:
    """Return DDC: 1, 0.5 or 0 by the longest way off the route's lanes within 1 s, intersections left out."""
    centres = ego.centres(body)
    # Way of each step, counted only off the route's lanes and outside of intersections
    way_m = np.append(0.0, np.hypot(*np.diff(centres, axis=0).T))
    way_m[~areas.oncoming | roads.in_intersection(centres)] = 0.0
    window = round(DIRECTION_S / STEP_S)
    # Longest sum over a window of 1 s
    longest_m = max(float(way_m[max(0, step - window) : step + 1].sum()) for step in range(len(way_m)))
    return 1.0 if longest_m < COMPLIES_M else 0.5 if longest_m < VIOLATES_M else 0.0


def traffic_light_compliance(ego: EgoMotion, body: EgoBody, others: Surroundings) -> float:
    """Return TLC: 0 if the vehicle is in a lane that a red light closes. 1 without known lights."""
    for corners, closed in zip(ego.corners(body), others.red_m, strict=False):
        outline = shapely.Polygon(corners)
        if any(outline.intersects(shapely.Polygon(lane)) for lane in closed):
            return 0.0
    return 1.0


def progress_m(ego: EgoMotion, body: EgoBody, roads: Roads) -> float:
    """Return the way along the centreline, at least 0 m."""
    centres = ego.centres(body)
    first, last = (roads.centreline.project(shapely.Point(*centres[step])) for step in (0, -1))
    return max(0.0, float(last - first))


def ego_progress(driven_m: float, multiplied: float, reference_m: float) -> float:
    """Return EP: progress by the better of one's own and of a reference planner's.

    Args:
        driven_m: own progress.
        multiplied: product of the own multipliers.
        reference_m: progress of the reference times the product of its multipliers.
    """
    best_m = max(driven_m * multiplied, reference_m)
    # Short references ask for no progress
    return 1.0 if best_m <= FAR_ENOUGH_M else min(max(driven_m / best_m, 0.0), 1.0)


def time_to_collision(
    ego: EgoMotion, body: EgoBody, areas: EgoAreas, roads: Roads, others: Surroundings
) -> float:
    """Return TTC: 0 if going on at constant velocity for up to 0.9 s would hit somebody ahead, else 1.

    The others move as they do. In several lanes, off the road and in intersections everybody counts who is
    not behind.
    """
    forgiven = set[int]()
    corners, crossing = ego.corners(body), roads.in_intersection(ego.xy_m)
    heading = np.stack([np.cos(ego.yaw_rad), np.sin(ego.yaw_rad)], axis=1)
    # Every step as a start; the vehicle goes on straight at its present speed
    for step in range(len(corners) - max(TTC_STEPS)):
        if ego.speed_mps[step] < TTC_STOPPED_MPS:
            continue
        for ahead in TTC_STEPS:
            outline = shapely.Polygon(corners[step] + heading[step] * ego.speed_mps[step] * STEP_S * ahead)
            for row, other in enumerate(others.outlines[step + ahead]):
                if other is None or row in forgiven or not outline.intersects(other):
                    continue
                angle_rad = _angle_rad(ego, step, other)
                leaves = bool(areas.multiple_lanes[step] or areas.off_road[step] or crossing[step])
                # Ahead counts always; beside only while the vehicle leaves its lane or crosses
                if angle_rad < AHEAD_RAD or (leaves and angle_rad <= BEHIND_RAD):
                    return 0.0
                forgiven.add(row)
    return 1.0


def lane_keeping(ego: EgoMotion, body: EgoBody, roads: Roads) -> float:
    """Return LK: 0 if the middle is far from the centreline for 2 s on end, else 1.

    Steps in intersections are left out: they neither count nor interrupt.
    """
    centres = ego.centres(body)
    away_m = shapely.distance(shapely.points(centres), roads.centreline)
    needed, run = math.ceil(ASIDE_S / STEP_S), 0
    # Consecutive steps outside of intersections
    for far in (away_m > ASIDE_M)[~roads.in_intersection(centres)].tolist():
        run = run + 1 if far else 0
        if run >= needed:
            return 0.0
    return 1.0
