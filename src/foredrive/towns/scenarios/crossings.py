"""Scenarios at the road's edge: crossing pedestrians and cyclists, also from between parked cars."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from foredrive.scene import Category
from foredrive.scene.actors import ActorState
from foredrive.towns.driving.collision_sense import SOLID
from foredrive.towns.scenarios.road_context import RoadContext, pose
from foredrive.towns.scenarios.scenario import Scenario, ScenarioKind
from foredrive.towns.traffic.scripted_actors import FIRST_TRACK_ID, ScriptedActor
from foredrive.towns.world import World

STEP_M, OFF_LANES_M = 0.5, 1.0
"""The road ends where there is no lane for `OFF_LANES_M`; `STEP_M` is the search step."""
MAX_RIGHT_M, MAX_LEFT_M = 12.0, 26.0
RUN_UP_M = 3.0
"""Additional distance from which cyclists start, m."""
HEIGHTS_M = (0.4, 0.9)
"""Heights at which nothing may block the crossing, m."""
EYE_M = 1.4
CLEAR_OF_END_M = 5.0
PARKED_ASIDE_M, PARKED_SKEW_RAD = (1.7, 4.2), 0.3
"""Lateral distance of a parked car from the route, m, and maximum angle to it, rad, for a pedestrian to
step out."""
STRAIGHT_M, STRAIGHT_COS = 20.0, 0.97
"""Distance before the car over which the route must be straight, m, and minimum cosine of its heading
change there."""
STEPS_OUT_M = 0.6
"""The pedestrian steps out this far before the car, m."""
INTO_LANE_M = 0.7
"""The pedestrian stops this far right of the route, m."""
PEDESTRIAN_LWH, CYCLIST_LWH = (0.5, 0.55, 1.72), (1.75, 0.6, 1.7)


def crossing(
    road: RoadContext, at_m: float, limit_mps: float, category: Category, seen_m: float
) -> Iterator[Scenario]:
    """Yield a crossing from the right, if its way is clear and the ego vehicle sees its start in time.

    Args:
        seen_m: distance before the crossing from which its start must be visible, m.
    """
    point, ahead = pose(road.route, at_m)
    # Straight across the route, from the right edge of the lanes to the left one
    left = np.array([-ahead[1], ahead[0], 0.0])
    right_m = _to_edge_m(road, point, -left, MAX_RIGHT_M)
    left_m = _to_edge_m(road, point, left, MAX_LEFT_M)
    if right_m is None or left_m is None:
        return
    cycles = category is Category.BICYCLE
    start_m = right_m + (RUN_UP_M if cycles else 0.0)
    # The way begins off the road, for cyclists with a run-up
    way = np.stack([point - start_m * left, point + left_m * left])
    # The driver must see the start from far enough, and nothing may stand in the way
    eye, _ = pose(road.route, max(at_m - seen_m, 0.0))
    if not _is_clear(road.world, way[0], way[1]) or not _is_seen(road.world, eye, way[0]):
        return
    kind = ScenarioKind.CROSSING_CYCLIST if cycles else ScenarioKind.CROSSING_PEDESTRIAN
    size = np.array(CYCLIST_LWH if cycles else PEDESTRIAN_LWH)
    actor = ScriptedActor(FIRST_TRACK_ID, category, 0, size, way)
    yield Scenario(kind, at_m, limit_mps, actor=actor, meet_m=start_m)


def _to_edge_m(
    road: RoadContext,
    point: Float64[np.ndarray, "3"],
    aside: Float64[np.ndarray, "3"],
    max_m: float,
) -> float | None:
    """Return the distance straight to one side at which the lanes end, m. None if they do not."""
    graph, near, free_m = road.graph, road.near, 0.0
    for away_m in np.arange(0.0, max_m, STEP_M).tolist():
        here = point + away_m * aside
        samples = near.within(here, 3.0)
        # Distance to the border of every lane nearby: negative inside
        off_m = np.hypot(*(near.xyz[samples, :2] - here[:2]).T) - 0.5 * graph.width_m[near.lane[samples]]
        free_m = 0.0 if (off_m < 0.0).any() else free_m + STEP_M
        if free_m > OFF_LANES_M:
            return float(away_m)
    return None


def beside_parked(road: RoadContext) -> Iterator[Scenario]:
    """Yield the pedestrians that may step out before parked cars."""
    route, graph = road.route, road.graph
    # Only cars close to the route; the pedestrian steps out just before the car
    for car in road.world.parked:
        away_m = np.hypot(*(route.xyz[:, :2] - car.centre_m[:2]).T)
        if away_m.min() > PARKED_ASIDE_M[1]:
            continue
        at_m = float(route.arc_m[np.argmin(away_m)]) + 0.5 * float(car.size_lwh[0]) + STEPS_OUT_M
        scenario = _before_car(road, car, at_m) if 0.0 < at_m < route.length_m - CLEAR_OF_END_M else None
        if scenario is not None and graph.junction[_lane_at(road, at_m)] < 0:
            yield scenario


def _before_car(road: RoadContext, car: ActorState, at_m: float) -> Scenario | None:
    point, ahead = pose(road.route, at_m)
    right = np.array([ahead[1], -ahead[0], 0.0])
    aside_m = float((car.centre_m - point) @ right)
    # Angle between car and route, modulo half a turn: cars may face either way
    skew = (car.yaw - np.arctan2(ahead[1], ahead[0]) + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    _, before = pose(road.route, max(at_m - STRAIGHT_M, 0.0))
    # On the right, parallel to a straight stretch of the route
    is_beside = PARKED_ASIDE_M[0] < aside_m < PARKED_ASIDE_M[1] and abs(skew) < PARKED_SKEW_RAD
    if not is_beside or before @ ahead < STRAIGHT_COS:
        return None
    start, out = point + aside_m * right, point + INTO_LANE_M * right
    if not _is_clear(road.world, start, out):
        return None
    limit = float(road.graph.limit_mps[_lane_at(road, at_m)])
    # Out into the lane and back the same way
    actor = ScriptedActor(
        FIRST_TRACK_ID, Category.PEDESTRIAN, 0, np.array(PEDESTRIAN_LWH), np.stack([start, out, start])
    )
    return Scenario(ScenarioKind.DOOR_ZONE, at_m, limit, actor=actor, meet_m=aside_m - INTO_LANE_M)


def _lane_at(road: RoadContext, at_m: float) -> int:
    point, _ = pose(road.route, at_m)
    _, sample = road.near.tree.query(point[:2])
    return int(road.near.lane[sample])


def _is_clear(world: World, start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"]) -> bool:
    """Return whether nothing stands between two points on the ground."""
    up = np.array([[0.0, 0.0, height] for height in HEIGHTS_M])
    # Rays in both directions: a ray that starts inside an object does not see it
    origins = np.concatenate([start + up, end + up])
    way = np.concatenate([np.tile(end - start, (len(up), 1)), np.tile(start - end, (len(up), 1))])
    return not _is_struck(world, origins, way)


def _is_seen(world: World, eye: Float64[np.ndarray, "3"], foot: Float64[np.ndarray, "3"]) -> bool:
    """Return whether a driver at `eye` sees a point on the ground."""
    up = np.array([0.0, 0.0, EYE_M])
    return not _is_struck(world, (eye + up)[None], (foot - eye)[None])


def _is_struck(world: World, origin: Float64[np.ndarray, "n 3"], way: Float64[np.ndarray, "n 3"]) -> bool:
    part, surface = world.struck(origin.astype(np.float32), way.astype(np.float32))
    return bool(((part <= 1.0) & SOLID[surface]).any())
