"""Facts for captions: the place of the vehicle, its action, and the road users around it."""

from collections.abc import Callable, Sequence

import numpy as np
import shapely
from jaxtyping import Bool, Float, Float64, Int
from scipy.spatial import cKDTree

from foredrive.data.setting import Doing, LightColour, ObjectKind, Place, Setting, TimeOfDay, Weather
from foredrive.geometry.polylines import arc_lengths
from foredrive.scene import Category, Command
from foredrive.scene.actors import ActorState
from foredrive.scene.conditions import Conditions
from foredrive.scene.traffic_light import LightState
from foredrive.towns.labels.captions import MIN_VISIBILITY, CaptionActor, FrameFacts
from foredrive.towns.map.town_map import StripKind, TownMap
from foredrive.towns.sensing.actor_shapes import VAN_HEIGHT_M, VAN_LENGTH_M
from foredrive.towns.traffic.expert import DriveSnapshot
from foredrive.towns.traffic.lane_graph import MOTORWAY_LIMIT_MPS, LaneControl, LaneGraph
from foredrive.towns.traffic.routes import Route

STANDING_MPS = 0.3
TURNING_RADPS = 0.05
CHANGING_MPS = 0.5
GENTLE_MPS2 = 1.0
LEADER_M, LEADER_LATERAL_M = 30.0, 1.6
FOLLOWED_M = 25.0
MIDDLE_M = 0.8
"""Height of a vehicle's middle above the road, m, because routes lie on the road."""
BUMPER_M = 3.0
LIGHT_M = 45.0
LAMPS_M = 50.0
"""Maximum distance of a lamp, m. Further away a lamp is only a part of a pixel."""
PASSES_OVER_M, BELOW_M = 4.0, 5.0
RING_M = (40.0, 250.0)
RING_RADIUS_M = 60.0
"""Maximum radius of the lanes of a roundabout, m. It does not apply to lanes shorter than `SHORT_M`."""
SHORT_M = 12.0
RING_LANES = 40
RING_TURN_RAD = 1.5 * np.pi
"""Minimum turn of a roundabout, rad. It is less than a full circle because turn is lost where lanes meet."""


class PlaceClassifier:
    """A classifier of the kind of place at points of a town."""

    def __init__(self, town: TownMap, lanes: LaneGraph) -> None:
        self._lanes = lanes
        self._of_lane = [_lane_place(lanes, lane) for lane in range(len(lanes.ids))]
        for lane in _ring_lanes(lanes):
            self._of_lane[lane] = Place.ROUNDABOUT
        self._samples = cKDTree(lanes.xyz)
        self._lane_of_sample = np.repeat(np.arange(len(lanes.ids)), lanes.count)
        self._over, self._under = _crossed_levels(lanes.xyz)
        self._roads = shapely.STRtree([strip.polygon for strip in town.strips_of(StripKind.DRIVING)])

    def classify(self, xyz: Float64[np.ndarray, "3"]) -> Place:
        """Return the kind of place at a point on the road."""
        sample = int(self._samples.query(xyz)[1])
        if self._over[sample]:
            return Place.BRIDGE
        if self._under[sample]:
            return Place.UNDERPASS
        return self._of_lane[int(self._lane_of_sample[sample])]

    def on_road(self, xy: Float64[np.ndarray, "N 2"]) -> Bool[np.ndarray, "N"]:
        """Return whether each point lies on a driving lane, seen from above."""
        out = np.zeros(len(xy), dtype=np.bool_)
        out[self._roads.query(shapely.points(xy), predicate="within")[0]] = True
        return out


class FactCollector:
    """A collector of the facts of the moments of one drive."""

    def __init__(
        self,
        town: TownMap,
        lanes: LaneGraph,
        route: Route,
        conditions: Conditions,
        signal_xyz: dict[int, Float64[np.ndarray, "_ 3"]],
    ) -> None:
        self._places, self._lanes = PlaceClassifier(town, lanes), lanes
        self._route, self._conditions = route, conditions
        self._signal_xyz = signal_xyz
        self._line = route.polyline(lanes)
        self._arc_m = arc_lengths(self._line)
        length = lanes.length_m[route.lanes]
        self._begins_m = np.cumsum(length) - length - route.start_m
        self._passed = 0
        self._last_lateral: tuple[float, float] | None = None

    def facts(
        self,
        snapshot: DriveSnapshot,
        actors: Sequence[ActorState],
        visibility: Float[np.ndarray, "M"],
        is_visible: Callable[[Float64[np.ndarray, "3"]], bool],
    ) -> FrameFacts:
        """Collect the facts of a moment. Calls must be in the order of time.

        Args:
            snapshot: the moment of the drive.
            actors: the road users around the vehicle.
            visibility: the visible share of each of them.
            is_visible: returns whether the cameras see a point (ego frame).
        """
        T_ego_world = np.linalg.inv(snapshot.T_world_ego)
        R, ego_xyz = T_ego_world[:3, :3], snapshot.T_world_ego[:3, 3]
        centre = np.array([actor.centre_m for actor in actors]).reshape(-1, 3)
        in_ego = centre @ R.T + T_ego_world[:3, 3]
        on_road = self._places.on_road(centre[:, :2])
        seen = zip(actors, in_ego, visibility.tolist(), on_road.tolist(), strict=True)
        things = [_caption_actor(*entry, R) for entry in seen]
        # The nearest route point ahead of the last one: routes may cross themselves
        window = slice(self._passed, self._passed + 200)
        self._passed += int(np.linalg.norm(self._line[window] - ego_xyz, axis=1).argmin())
        lateral_mps = self._lateral_speed(snapshot)
        # While overtaking, the leader is searched along the vehicle's own lane, parallel to the route
        beside = ego_xyz - self._line[self._passed]  # the lane beside the route's, while overtaking
        leader, gap_m = self._leader(actors, centre - beside, visibility)
        now = self._conditions
        setting = Setting(
            time_of_day=TimeOfDay.at_hour(now.hour),
            weather=Weather.under(now),
            place=self._places.classify(ego_xyz),
            doing=self._doing(snapshot, leader, gap_m, lateral_mps),
            speed_mps=float(snapshot.twist_ego[0]),
            leader=None if leader is None else object_kind(leader),
            light=self._light(snapshot, T_ego_world, is_visible),
            hour=now.hour,
            clouds=now.clouds,
            rain_mmph=now.rain_mmph,
            wetness=now.wetness,
            visibility_m=now.visibility_m,
        )
        return FrameFacts(setting, things)

    def _leader(
        self,
        actors: Sequence[ActorState],
        centre: Float64[np.ndarray, "M 3"],
        visibility: Float[np.ndarray, "M"],
    ) -> tuple[ActorState | None, float]:
        """Return the next visible vehicle on the route, and the distance to its middle, m."""
        # Points of the route ahead, and the distance of every actor from them
        end = int(np.searchsorted(self._arc_m, self._arc_m[self._passed] + LEADER_M))
        way, arc_m = self._line[self._passed : end], self._arc_m[self._passed : end]
        if not len(way) or not len(centre):
            return None, np.inf
        away_m, index = (np.asarray(column) for column in cKDTree(way).query(centre - [0.0, 0.0, MIDDLE_M]))
        # Distance along the route of the nearest point; vehicles beside it and too near ones do not lead
        ahead_m = arc_m[index] - arc_m[0]
        vehicle = [not (a.parked or a.category is Category.PEDESTRIAN) for a in actors]
        candidate = (
            vehicle & (away_m < LEADER_LATERAL_M) & (ahead_m > BUMPER_M) & (visibility >= MIN_VISIBILITY)
        )
        if not candidate.any():
            return None, np.inf
        best = int(np.where(candidate, ahead_m, np.inf).argmin())
        return actors[best], float(ahead_m[best])

    def _lateral_speed(self, snapshot: DriveSnapshot) -> float:
        """Return the speed of the vehicle to the left of its route, m/s; 0 at the first moment."""
        before, self._last_lateral = self._last_lateral, (snapshot.t_s, self._lateral_offset_m(snapshot))
        return 0.0 if before is None else (self._last_lateral[1] - before[1]) / (snapshot.t_s - before[0])

    def _lateral_offset_m(self, snapshot: DriveSnapshot) -> float:
        k = min(self._passed, len(self._line) - 2)
        # Cross product of route direction and offset: positive to the left
        ahead, offset = self._line[k + 1] - self._line[k], snapshot.T_world_ego[:3, 3] - self._line[k]
        return float(ahead[0] * offset[1] - ahead[1] * offset[0]) / float(np.hypot(*ahead[:2]))

    def _doing(
        self, snapshot: DriveSnapshot, leader: ActorState | None, gap_m: float, lateral_mps: float
    ) -> Doing:
        speed, turn_rate = float(snapshot.twist_ego[0]), float(snapshot.twist_ego[5])
        # Order of precedence: standing, turning, changing lanes, slowing, following, speeding up
        if speed < STANDING_MPS:
            return Doing.WAITS
        row = int(np.searchsorted(self._begins_m, self._arc_m[self._passed], side="right")) - 1
        command = self._lanes.command(int(self._route.lanes[max(row, 0)]))
        if command is not Command.STRAIGHT and abs(turn_rate) > TURNING_RADPS:
            return Doing.TURNS_LEFT if command is Command.LEFT else Doing.TURNS_RIGHT
        if abs(lateral_mps) > CHANGING_MPS:
            return Doing.CHANGES_LEFT if lateral_mps > 0 else Doing.CHANGES_RIGHT
        acceleration = float(snapshot.acceleration_ego_mps2[0])
        if acceleration < -GENTLE_MPS2:
            return Doing.SLOWS
        if leader is not None and gap_m < FOLLOWED_M and np.linalg.norm(leader.velocity_mps) > STANDING_MPS:
            return Doing.FOLLOWS
        return Doing.SPEEDS_UP if acceleration > GENTLE_MPS2 else Doing.DRIVES

    def _light(
        self,
        snapshot: DriveSnapshot,
        T_ego_world: Float64[np.ndarray, "4 4"],
        is_visible: Callable[[Float64[np.ndarray, "3"]], bool],
    ) -> LightColour | None:
        """Return the colour of the next light on the route if its lamps are in view."""
        axle_m = float(self._arc_m[self._passed])
        # Lanes of the route in order; the first one with a light ahead decides
        for lane, begin_m in zip(self._route.lanes, self._begins_m, strict=True):
            if begin_m > axle_m + LIGHT_M:
                break
            zone = int(self._lanes.zone[lane])
            if (
                begin_m > axle_m
                and self._lanes.control[lane] == LaneControl.LIGHT
                and zone in self._signal_xyz
            ):
                lamps = self._signal_xyz[zone] @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
                in_view = any(np.linalg.norm(lamp) < LAMPS_M and is_visible(lamp) for lamp in lamps)
                return _COLOUR_OF_LIGHT.get(LightState(int(snapshot.lights[zone]))) if in_view else None
        return None


_COLOUR_OF_LIGHT = {
    LightState.RED: LightColour.RED,
    LightState.YELLOW: LightColour.YELLOW,
    LightState.GREEN: LightColour.GREEN,
}


def object_kind(actor: ActorState) -> ObjectKind:
    """Return the name of a road user by its appearance, which distinguishes vans from cars."""
    if actor.category is Category.CAR:
        length_m, _, height_m = actor.size_lwh
        return ObjectKind.VAN if length_m > VAN_LENGTH_M and height_m > VAN_HEIGHT_M else ObjectKind.CAR
    return _KIND_OF_CATEGORY[actor.category]


_KIND_OF_CATEGORY = {
    Category.TRUCK: ObjectKind.TRUCK,
    Category.BUS: ObjectKind.BUS,
    Category.TRAILER: ObjectKind.TRAILER,
    Category.CONSTRUCTION_VEHICLE: ObjectKind.CONSTRUCTION_VEHICLE,
    Category.MOTORCYCLE: ObjectKind.MOTORCYCLE,
    Category.BICYCLE: ObjectKind.CYCLIST,
    Category.PEDESTRIAN: ObjectKind.PEDESTRIAN,
    Category.ANIMAL: ObjectKind.ANIMAL,
    Category.TRAFFIC_CONE: ObjectKind.TRAFFIC_CONE,
    Category.BARRIER: ObjectKind.BARRIER,
    Category.OTHER: ObjectKind.OBJECT,
}


def _caption_actor(
    actor: ActorState,
    xyz: Float64[np.ndarray, "3"],
    seen: float,
    on_road: bool,
    R: Float64[np.ndarray, "3 3"],
) -> CaptionActor:
    heading = R @ [np.cos(actor.yaw), np.sin(actor.yaw), 0.0]
    return CaptionActor(
        kind=object_kind(actor),
        xy_m=xyz[:2],
        velocity_mps=(R @ actor.velocity_mps)[:2],
        yaw=float(np.arctan2(heading[1], heading[0])),
        visibility=seen,
        parked=actor.parked,
        on_road=on_road,
    )


def _lane_place(lanes: LaneGraph, lane: int) -> Place:
    if lanes.limit_mps[lane] > MOTORWAY_LIMIT_MPS:
        return Place.HIGHWAY
    return Place.JUNCTION if lanes.junction[lane] >= 0 else Place.STREET


def _crossed_levels(
    xyz: Float64[np.ndarray, "P 3"],
) -> tuple[Bool[np.ndarray, "P"], Bool[np.ndarray, "P"]]:
    """Return which points of lanes are above another lane, and which are below one."""
    over, under = np.zeros((2, len(xyz)), dtype=np.bool_)
    if np.ptp(xyz[:, 2]) < PASSES_OVER_M:
        return over, under
    # Pairs that are close seen from above and far apart in height
    pairs = cKDTree(xyz[:, :2]).query_pairs(BELOW_M, output_type="ndarray")
    rise_m = xyz[pairs[:, 0], 2] - xyz[pairs[:, 1], 2]
    for high, low in (pairs[rise_m > PASSES_OVER_M].T, pairs[rise_m < -PASSES_OVER_M].T[::-1]):
        over[high], under[low] = True, True
    return over, under


def _ring_lanes(lanes: LaneGraph) -> Int[np.ndarray, "R"]:
    """Return the lanes of roundabouts: closed paths that turn left throughout, and lanes in the same
    junctions."""
    # Lanes that turn left at least as tightly as `RING_RADIUS_M`; short ones may be straight
    bends = lanes.turn_rad > np.where(lanes.length_m < SHORT_M, -0.1, lanes.length_m / RING_RADIUS_M)
    ring: set[int] = set()
    for start in np.flatnonzero(bends & (lanes.length_m >= SHORT_M)).tolist():
        if start not in ring:
            ring.update(_ring_from(lanes, start, bends))
    rings = np.array(sorted(ring), dtype=np.int64)
    junctions = np.setdiff1d(lanes.junction[rings], [-1])
    return np.union1d(rings, np.flatnonzero(np.isin(lanes.junction, junctions)))


def _ring_from(lanes: LaneGraph, start: int, bends: Bool[np.ndarray, "L"]) -> list[int]:
    """Return the lanes of a ring that contains a lane; empty if there is none."""
    # Depth-first search for a closed path with the length and the turn of a roundabout
    ways = [[start]]
    while ways:
        way = ways.pop()
        length_m, turn_rad = float(lanes.length_m[way].sum()), float(lanes.turn_rad[way].sum())
        if length_m > RING_M[1] or len(way) > RING_LANES:
            continue
        for after in lanes.successors[way[-1], : lanes.successor_count[way[-1]]].tolist():
            if after == start and length_m > RING_M[0] and turn_rad > RING_TURN_RAD:
                return way
            # Only lanes that bend, and none twice
            if bends[after] and after not in way:
                ways.append([*way, after])
    return []
