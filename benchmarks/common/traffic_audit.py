"""Count errors of the traffic simulation: overlaps, leaving the road, red lights, standing for ever."""

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int

from foredrive.scene.traffic_light import LightState
from foredrive.towns.map.town_map import StripKind, TownMap
from foredrive.towns.traffic.traffic import Traffic, TrafficState
from foredrive.towns.traffic.vehicles import BEHIND, Poses

LEVEL_M = 2.0
"""Minimum height difference at which actors pass over or under each other, m."""
ROAD_MARGIN_M = 0.5
WALK_MARGIN_M = 1.0
"""Margin of the walkable area, m: pedestrians cut corners where walks meet."""
CROSSING_REACH_M = 1.5
SPEEDING = 1.1
HARD_BRAKING_MPS2 = 6.0
LATERAL_MPS2 = 5.0
YAW_RATE_RADPS = 1.5
JUMP_M = 0.15
MOVES_M = 1.0
STUCK_S = 240.0
LOOK_EVERY = 3
"""Outlines are compared only at every third step."""
DRIVABLE = (
    StripKind.DRIVING,
    StripKind.SHOULDER,
    StripKind.PARKING,
    StripKind.BORDER,
    StripKind.BIDIRECTIONAL,
)
VIOLATIONS = (
    "vehicle_overlaps",
    "person_overlaps",
    "people_astray",
    "off_road",
    "red_lights",
    "speeding",
    "hard_braking",
    "sharp_turns",
    "jumps",
    "stuck",
)


class Audit:
    """Watches steps of traffic; each violation counts once for each actor or pair of actors."""

    def __init__(self, town: TownMap, traffic: Traffic) -> None:
        self._traffic = traffic
        strips = [strip.polygon.buffer(ROAD_MARGIN_M) for strip in town.strips_of(*DRIVABLE)]
        self._road = shapely.union_all(strips)
        shapely.prepare(self._road)
        self._walkable = _walkable(town, traffic)
        shapely.prepare(self._walkable)
        self._found: dict[str, set[tuple[int, ...]]] = {name: set() for name in VIOLATIONS}
        self._moved: dict[int, tuple[float, Float64[np.ndarray, 3]]] = {}
        self._poses: tuple[TrafficState, Poses] | None = None
        self.lane_changes = 0

    @property
    def counts(self) -> dict[str, int]:
        """Return the number of each of `VIOLATIONS`."""
        return {name: len(found) for name, found in self._found.items()}

    @property
    def examples(self) -> dict[str, list[tuple[int, ...]]]:
        """Return the track ids of each violation."""
        return {name: sorted(found) for name, found in self._found.items()}

    def watch(self, before: TrafficState, after: TrafficState, poses: Poses | None = None) -> None:
        """Check one step.

        Args:
            poses: poses of the vehicles after the step, if one of them is not on its path.
        """
        then = self._poses_of(before)
        now = poses or self._traffic.poses(after)
        self._poses = after, now
        v, w = before.vehicles, after.vehicles
        same = v.active & w.active & (v.track_id == w.track_id)
        dt_s = after.time_s - before.time_s
        turned = (now.yaw - then.yaw + np.pi) % (2 * np.pi) - np.pi
        moved = np.linalg.norm(now.axle_xyz - then.axle_xyz, axis=1)
        driven = 0.5 * dt_s * (v.speed_mps + w.speed_mps)
        limit = self._traffic.lanes.limit_mps[np.maximum(w.lane, 0)]
        self._note("jumps", same & (np.abs(moved - driven) > JUMP_M), after)
        self._note("speeding", w.active & (w.speed_mps > SPEEDING * limit), after)
        self._note("hard_braking", w.active & (w.acceleration_mps2 < -HARD_BRAKING_MPS2), after)
        rate = np.abs(turned) / dt_s
        sharp = (rate > YAW_RATE_RADPS) | (rate * w.speed_mps > LATERAL_MPS2)
        self._note("sharp_turns", same & sharp, after)
        self._note("red_lights", same & self._runs_red(before, after), after)
        self.lane_changes += int((same & (w.changed_m < 0) & (v.changed_m >= 0)).sum())
        if after.step_index % LOOK_EVERY == 0:
            self._compare_outlines(after, now)
            self._find_stuck(after, now)

    def _poses_of(self, state: TrafficState) -> Poses:
        known = self._poses is not None and self._poses[0] is state
        return self._poses[1] if known and self._poses else self._traffic.poses(state)

    def _note(self, name: str, who: Bool[np.ndarray, "N"], state: TrafficState) -> None:
        self._found[name] |= {(int(i),) for i in state.vehicles.track_id[who]}

    def _runs_red(self, before: TrafficState, after: TrafficState) -> Bool[np.ndarray, "N"]:
        graph, signals, v, w = self._traffic.lanes, self._traffic.signals, before.vehicles, after.vehicles
        ahead = v.path[:, BEHIND + 1]
        stays = w.lane == v.lane
        reaches = ~stays | (w.front_m > graph.length_m[w.lane])
        crosses = (v.front_m <= graph.length_m[v.lane]) & reaches & (w.lane == np.where(stays, v.lane, ahead))
        return (
            crosses & signals.guarded[ahead] & (signals.light_states(before.time_s)[ahead] == LightState.RED)
        )

    def _compare_outlines(self, state: TrafficState, poses: Poses) -> None:
        live = np.flatnonzero(state.vehicles.active)
        outlines = _outlines(poses, state, live)
        track, z = state.vehicles.track_id[live], poses.centre_m[live, 2]
        tree = shapely.STRtree(outlines)
        a, b = tree.query(outlines, predicate="intersects")
        hit = (a < b) & (np.abs(z[a] - z[b]) < LEVEL_M)
        pairs = np.sort(np.stack([track[a[hit]], track[b[hit]]], axis=1), axis=1)
        self._found["vehicle_overlaps"] |= {(int(i), int(j)) for i, j in pairs}
        off = np.zeros(len(state.vehicles.active), dtype=np.bool_)
        off[live] = ~shapely.covers(self._road, outlines)
        self._note("off_road", off, state)
        people = state.people
        walking = np.flatnonzero(people.active)
        feet = shapely.points(people.xyz[walking, :2])
        astray = walking[~shapely.covers(self._walkable, feet)]
        self._found["people_astray"] |= {(int(i),) for i in people.track_id[astray]}
        p, c = tree.query(feet, predicate="intersects")
        met = np.abs(people.xyz[walking[p], 2] - z[c]) < LEVEL_M
        ids: Int[np.ndarray, "K 2"] = np.stack([people.track_id[walking[p[met]]], track[c[met]]], axis=1)
        self._found["person_overlaps"] |= {(int(i), int(j)) for i, j in ids}

    def _find_stuck(self, state: TrafficState, poses: Poses) -> None:
        stuck = np.zeros(len(state.vehicles.active), dtype=np.bool_)
        seen = {}
        for i in np.flatnonzero(state.vehicles.active):
            track, place = int(state.vehicles.track_id[i]), poses.centre_m[i]
            since, where = self._moved.get(track, (state.time_s, place))
            if np.linalg.norm(place - where) > MOVES_M:
                since, where = state.time_s, place
            seen[track] = since, where
            stuck[i] = state.time_s - since > STUCK_S
        self._moved = seen
        self._note("stuck", stuck, state)


def _walkable(town: TownMap, traffic: Traffic) -> shapely.Geometry:
    """Return the area in which pedestrians may be: walkways, which are never built over, and crossings."""
    walks = traffic.walks
    crossings = [
        shapely.LineString(walks.xyz[walks.first[i] : walks.first[i + 1], :2]).buffer(CROSSING_REACH_M)
        for i in np.flatnonzero(walks.is_crossing)
    ]
    walkways = [strip.polygon.buffer(WALK_MARGIN_M) for strip in town.strips_of(StripKind.SIDEWALK)]
    return shapely.union_all([*walkways, *crossings])


def _outlines(poses: Poses, state: TrafficState, live: Int[np.ndarray, "K"]) -> np.ndarray:
    """Return oriented boxes from above."""
    yaw, size = poses.yaw[live], 0.5 * state.vehicles.size_lwh[live]
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * size[:, :1]
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) * size[:, 1:2]
    centre = poses.centre_m[live, :2]
    corners = [centre + ahead + left, centre + ahead - left, centre - ahead - left, centre - ahead + left]
    return np.asarray(shapely.polygons(np.stack(corners, axis=1)))
