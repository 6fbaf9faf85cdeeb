"""Maps of the towns against CARLA's own client: `foredrive bench town-maps`, about a minute.

Every sample of every driving lane, a metre apart, is looked up in the same OpenDRIVE file by `carla.Map`,
which needs no server (extra `carla`). Place, height and width are compared at the samples, headings between
two of them. Heights are also given without junctions: there the town brings crossing roads to one height.

Links are pairs of driving lanes one of which leads into the other. Lights and signs are those whose lanes, to
which they apply, are the same. A crossing's agreement is the area in both over the area in either. CARLA's
client does not tell a road's speed limit but has the speed signs: the figure is the share of signs with the
limit of the road that they stand at.

A large town is compared in the tile that `LARGE_TOWNS` names, with whole roads.
"""

import gzip
import math
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float64

from benchmarks.common.benchmark import Benchmark
from foredrive.integrations.carla.client import import_carla
from foredrive.towns.map.loading import MAP_FOLDER, load_roads, load_town_map
from foredrive.towns.map.names import LARGE_TOWNS, TOWNS, town_of
from foredrive.towns.map.town_map import Crosswalk, Lane, Marking, Strip, TownMap, marking_at
from foredrive.towns.traffic.lane_graph import CROSSABLE

LIGHT, STOP, YIELD, SPEED = "1000001", "206", "205", "274"
"""Types of landmarks."""
INSIDE_M = 1e-3
"""A lane is looked up at least this far from its ends, where the next section begins."""
MPH = 0.44704
LARGE_M, LARGE_DEG = 0.1, 1.0
"""Differences above these are counted."""

LaneKey = tuple[int, int, int]
"""Road, section and lane of OpenDRIVE."""


def key_of(lane_id: str) -> LaneKey:
    """Return the OpenDRIVE numbers of a lane of py123d."""
    road, section, _, lane = lane_id.split("_")
    return int(road), int(section), int(lane)


@dataclass(frozen=True)
class ClientMap:
    """A town's map in CARLA's client, in the right-handed frame of the towns."""

    client: Any
    """A `carla.Map`."""
    sections: Mapping[tuple[int, int], tuple[float, float]]
    """First and last s of each section of a road, m."""

    @classmethod
    def read(cls, town: str) -> "ClientMap":
        """Read a town's OpenDRIVE file with the client."""
        return cls.of(town, gzip.decompress((MAP_FOLDER / f"{town}.xodr.gz").read_bytes()).decode())

    @classmethod
    def of(cls, name: str, text: str) -> "ClientMap":
        """Read the text of an OpenDRIVE file with the client."""
        sections = {}
        for road in ElementTree.fromstring(text).iter("road"):
            starts = [float(section.get("s", "nan")) for section in road.iterfind("lanes/laneSection")]
            ends = [*starts[1:], float(road.get("length", "nan"))]
            for index, ends_at in enumerate(zip(starts, ends, strict=True)):
                sections[int(road.get("id", "")), index] = ends_at
        return cls(import_carla().Map(name, text), sections)

    def lane_at(self, key: LaneKey, share: Float64[np.ndarray, "N"]) -> list[Any]:
        """Return the waypoints of a lane at shares of its length, in the direction of travel."""
        road, section, lane = key
        start, end = self.sections[road, section]
        s = start + (share if lane < 0 else 1.0 - share) * (end - start)
        inside = np.clip(s, start + INSIDE_M, max(end - INSIDE_M, start + INSIDE_M))
        return [self.client.get_waypoint_xodr(road, lane, at) for at in inside.tolist()]

    @cached_property
    def links(self) -> set[tuple[LaneKey, LaneKey]]:
        """Return the pairs of lanes one of which leads into the other."""
        pairs = self.client.get_topology()
        return {(_waypoint_key(start), _waypoint_key(end)) for start, end in pairs}

    @cached_property
    def governed(self) -> dict[int, set[tuple[int, int]]]:
        """Return the lanes (road and lane) that each light, stop sign and yield sign applies to."""
        lanes: dict[int, set[tuple[int, int]]] = defaultdict(set)
        for landmark in self.client.get_all_landmarks():
            if landmark.type in (LIGHT, STOP, YIELD):
                for low, high in landmark.get_lane_validities():
                    lanes[int(landmark.id)] |= {(landmark.road_id, lane) for lane in range(low, high + 1)}
        return lanes

    @cached_property
    def crossings(self) -> list[shapely.Polygon]:
        """Return the outlines of all crossings, each of which the client ends with its first corner."""
        rings: list[list[tuple[float, float]]] = [[]]
        for corner in self.client.get_crosswalks():
            ring, xy = rings[-1], (corner.x, -corner.y)
            ring.append(xy)
            if len(ring) > 2 and math.dist(ring[0], xy) < INSIDE_M:
                rings.append([])
        return [shapely.Polygon(ring) for ring in rings if ring]


def _waypoint_key(waypoint: Any) -> LaneKey:
    return waypoint.road_id, waypoint.section_id, waypoint.lane_id


def _xyz(waypoints: Sequence[Any]) -> Float64[np.ndarray, "N 3"]:
    places = [waypoint.transform.location for waypoint in waypoints]
    return np.array([(place.x, -place.y, place.z) for place in places])


def lane_differences(strip: Strip, client: ClientMap) -> dict[str, Float64[np.ndarray, "_"]]:
    """Return the absolute differences along a lane's strip: place, height, width in m, heading in degrees."""
    key, line = key_of(strip.id), 0.5 * (strip.left_xyz + strip.right_xyz)
    share = np.linspace(0.0, 1.0, len(line))
    waypoints = client.lane_at(key, share)
    theirs = _xyz(waypoints)
    width_m = np.linalg.norm(strip.left_xyz - strip.right_xyz, axis=1)
    # The chord between two samples has the heading of the lane halfway
    step = np.diff(line[:, :2], axis=0)
    between = client.lane_at(key, 0.5 * (share[1:] + share[:-1]))
    yaw_deg = np.array([-waypoint.transform.rotation.yaw for waypoint in between])
    turned = np.degrees(np.arctan2(step[:, 1], step[:, 0])) - yaw_deg
    return {
        "lane": np.linalg.norm(line[:, :2] - theirs[:, :2], axis=1),
        "height": np.abs(line[:, 2] - theirs[:, 2]),
        "width": np.abs(width_m - [waypoint.lane_width for waypoint in waypoints]),
        "heading": np.abs((turned + 180.0) % 360.0 - 180.0),
    }


def lane_changes_equal(lane: Lane, strip: Strip, client: ClientMap) -> tuple[int, int]:
    """Return how often both maps allow or forbid a change to a lane beside, and how often there is one.

    They are asked at each sample and on each side where a lane of the same direction lies: CARLA's answer
    does not depend on whether there is one.
    """
    key, changes = key_of(lane.lane_id), import_carla().LaneChange
    share = np.linspace(0.0, 1.0, len(lane.centreline_xyz))[1:-1]
    start, end = client.sections[key[:2]]
    equal, asked = 0, 0
    for at, waypoint in zip(share * (end - start), client.lane_at(key, share), strict=True):
        for beside, markings, side in (
            (lane.left_id, strip.left_markings, changes.Left),
            (lane.right_id, strip.right_markings, changes.Right),
        ):
            if beside is not None:
                asked += 1
                equal += _crossable(markings, at) == bool(waypoint.lane_change & side)
    return equal, asked


def _crossable(markings: tuple[Marking, ...], along_m: float) -> bool:
    marking = marking_at(markings, along_m)
    return marking is None or marking.kind in CROSSABLE


def crossings_agree(ours: Sequence[Crosswalk], client: ClientMap) -> dict[str, float]:
    """Return the mean and the least overlap of crossings (intersection over union), and how many have one."""
    outlines = [shapely.Polygon(crossing.outline_xyz[:, :2]).buffer(0.0) for crossing in ours]
    tree, overlap = shapely.STRtree(client.crossings), []
    for outline in outlines:
        near = [client.crossings[i].buffer(0.0) for i in tree.query(outline)]
        overlap.append(max((outline.intersection(n).area / outline.union(n).area for n in near), default=0.0))
    if not overlap:
        return {}
    return {
        "crossings": len(overlap),
        "crossing_iou_mean": np.mean(overlap),
        "crossing_iou_min": min(overlap),
    }


def compare_town(name: str, seed: int) -> Mapping[str, float]:
    """Return how well the map of a town, or of a tile's roads, agrees with CARLA's client."""
    roads, client = load_roads(name), ClientMap.read(town_of(name))
    inside = {lane.lane_id for lane in load_town_map(name).lanes}
    lanes = [lane for lane in roads.lanes if lane.lane_id in inside]
    strips = {strip.id: strip for strip in roads.strips}
    found: dict[str, list[np.ndarray]] = defaultdict(list)
    for lane in lanes:
        for what, differences in lane_differences(strips[lane.lane_id], client).items():
            found[what].append(differences)
            if what == "height" and lane.junction_id is None:
                found["road_height"].append(differences)
    figures: dict[str, float] = {"lanes": len(lanes), "samples": sum(map(len, found["lane"]))}
    for what, parts in found.items():
        values, unit = np.concatenate(parts), "deg" if what == "heading" else "m"
        limit = LARGE_DEG if what == "heading" else LARGE_M
        figures |= {
            f"{what}_p95_{unit}": np.percentile(values, 95),
            f"{what}_max_{unit}": values.max(),
            f"{what}_large_pct": 100.0 * (values > limit).mean(),
        }
    equal, asked = np.sum([lane_changes_equal(lane, strips[lane.lane_id], client) for lane in lanes], axis=0)
    if asked:
        figures["lane_changes_equal_pct"] = 100.0 * equal / asked
    return figures | _rules_agree(roads, lanes, client) | crossings_agree(roads.crosswalks, client)


def _rules_agree(roads: TownMap, lanes: Sequence[Lane], client: ClientMap) -> dict[str, float]:
    keys = {key_of(lane.lane_id) for lane in lanes}
    # Links between lanes of the town; those out of a tile are not of it
    ours = {(key_of(lane.lane_id), key_of(name)) for lane in lanes for name in lane.successor_ids}
    ours = {link for link in ours if link[1] in keys}
    theirs = {link for link in client.links if link[0] in keys and link[1] in keys}
    driving = {(road, lane) for road, _, lane in keys}
    zones = {zone.id: {key_of(name)[::2] for name in zone.lane_ids} & driving for zone in roads.stop_zones}
    governed = {number: lanes & driving for number, lanes in client.governed.items()}
    signals = {number for number, lanes in (*zones.items(), *governed.items()) if lanes}
    equal = sum(zones.get(number) == governed.get(number) for number in signals)
    figures = {
        "links": float(len(ours | theirs)),
        "links_equal_pct": 100.0 * len(ours & theirs) / len(ours | theirs),
    }
    if signals:
        figures |= {"lights": float(len(signals)), "lights_equal_pct": 100.0 * equal / len(signals)}
    limits = {key_of(lane.lane_id)[0]: lane.speed_limit_mps for lane in lanes}
    signs = [sign for sign in client.client.get_all_landmarks_of_type(SPEED) if limits.get(sign.road_id)]
    if signs:
        same = [abs(sign.value * MPH - (limits[sign.road_id] or 0.0)) < 0.1 for sign in signs]
        figures |= {"speed_signs": float(len(signs)), "speed_signs_equal_pct": 100.0 * float(np.mean(same))}
    return figures


BENCHMARK = Benchmark(
    question="Do the maps of the towns agree with CARLA's own client, metre by metre?",
    arms={name: partial(compare_town, name) for name in (*TOWNS, *LARGE_TOWNS.values())},
    seeds=(0,),
    decided_by=("foredrive.towns.map",),
)
