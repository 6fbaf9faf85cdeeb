"""123D maps: the patch around the ego vehicle as polylines, and writing of maps shared by logs."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from py123d.api.map.arrow.arrow_map_writer import ArrowMapWriter
from py123d.datatypes import (
    BaseMapObject,
    BaseMapSurfaceObject,
    Lane,
    MapLayer,
    MapMetadata,
    RoadEdge,
)
from py123d.geometry import Point2D, Polyline2D, Polyline3D

from foredrive.data.arrow_files import reading
from foredrive.data.log_writer import DATASET
from foredrive.data.logs import Log
from foredrive.files import atomic_path
from foredrive.scene import MapKind, MapPatch

RADIUS_M = 60.0
VERTICES = 32
"""Maximum number of vertices. Longer polylines are cut into pieces that share an end."""

_OUTLINE_KIND = {
    MapLayer.CROSSWALK: MapKind.CROSSWALK,
    MapLayer.WALKWAY: MapKind.WALKWAY,
    MapLayer.STOP_ZONE: MapKind.STOP_ZONE,
    MapLayer.INTERSECTION: MapKind.INTERSECTION,
}


def read_map_patch(log: Log, frame: int) -> MapPatch:
    """Read the map within RADIUS_M of the ego vehicle at a frame, unbatched. Without a map it is empty.

    Raises:
        InputError: the map cannot be read.
    """
    T_world_ego = log.T_world_ego[frame]
    pieces: list[tuple[MapKind, np.ndarray]] = []
    with reading(log.path.folder, "its map"):
        api = log.scene.get_map_api()
        if api is not None:
            layers = [MapLayer.LANE, MapLayer.ROAD_EDGE, *_OUTLINE_KIND]
            centre = Point2D(*T_world_ego[:2, 3])
            near = api.get_map_objects_in_radius(centre, RADIUS_M, layers)
            flat = not api.get_map_metadata().map_has_z
            T_ego_world = np.linalg.inv(T_world_ego)
            for kind, line in _lines(item for items in near.values() for item in items):
                # A map without heights is taken as level: pitch and roll must not lift far lines. Some of its
                # lines have a third column all the same
                if flat:
                    line = np.column_stack([line[:, :2], np.full(len(line), T_world_ego[2, 3])])
                line = line @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
                if flat:
                    line[:, 2] = 0.0
                pieces += [(kind, piece) for piece in _pieces(line)]
    vertices = torch.zeros(len(pieces), VERTICES, 3)
    valid = torch.zeros(len(pieces), VERTICES, dtype=torch.bool)
    for row, (_, piece) in enumerate(pieces):
        vertices[row, : len(piece)] = torch.from_numpy(piece).float()
        valid[row, : len(piece)] = True
    kinds = torch.tensor([int(kind) for kind, _ in pieces], dtype=torch.int64)
    return MapPatch(vertices=vertices, valid=valid, kind=kinds)


def read_lane_outlines(log: Log) -> list[Float64[np.ndarray, "_ 2"]] | None:
    """Read the outlines of the lanes around the driven path, world frame. Return None without a map.

    The lanes are those within a circle around the whole path, enlarged by RADIUS_M.

    Raises:
        InputError: the map cannot be read.
    """
    driven = log.T_world_ego[:, :2, 3]
    middle = 0.5 * (driven.min(axis=0) + driven.max(axis=0))
    reach_m = float(np.hypot(*(driven - middle).T).max()) + RADIUS_M
    with reading(log.path.folder, "its map"):
        api = log.scene.get_map_api()
        if api is None:
            return None
        near = api.get_map_objects_in_radius(Point2D(*middle), reach_m, [MapLayer.LANE])
        lanes = [lane for lane in near[MapLayer.LANE] if isinstance(lane, Lane)]
        sides = [(_points(lane.left_boundary)[:, :2], _points(lane.right_boundary)[:, :2]) for lane in lanes]
    return [np.concatenate([left, right[::-1]]) for left, right in sides]


def map_file(log: Log) -> Path | None:
    """Return the file of a log's own map, or of the map that it shares, if there is one."""
    own, metadata = log.path.folder / "map.arrow", log.metadata
    shared = log.path.maps_dir / metadata.dataset / f"{metadata.dataset}_{metadata.location}.arrow"
    return next((file for file in (own, shared) if file.is_file()), None)


def write_map(objects: Iterable[BaseMapObject], location: str, root: Path) -> Path:
    """Write a map with heights, unless it exists. All logs of `location` in the data root share it.

    Returns:
        The folder for the argument `map_dir` of `LogWriter`.
    """
    maps_dir = Path(root) / "maps"
    final = maps_dir / DATASET / f"{DATASET}_{location}.arrow"
    if not final.is_file():
        # Several processes may write the map of one location at the same time; each writes its own copy
        with atomic_path(final) as temporary:
            scratch = temporary.parent
            writer = ArrowMapWriter(force_map_conversion=True, maps_root=scratch, logs_root=scratch)
            writer.reset(MapMetadata(DATASET, location, map_has_z=True, map_is_per_log=False))
            for item in objects:
                writer.write_map_object(item)
            writer.close()
            (scratch / DATASET / final.name).rename(temporary)
    return maps_dir


def _lines(objects: Iterable[BaseMapObject]) -> Iterator[tuple[MapKind, Float64[np.ndarray, "V D"]]]:
    for item in objects:
        if isinstance(item, Lane):
            yield MapKind.LANE_CENTRE, _points(item.centerline)
            yield MapKind.LANE_BOUNDARY, _points(item.left_boundary)
            yield MapKind.LANE_BOUNDARY, _points(item.right_boundary)
        elif isinstance(item, RoadEdge):
            yield MapKind.ROAD_EDGE, _points(item.polyline)
        elif isinstance(item, BaseMapSurfaceObject):
            yield _OUTLINE_KIND[item.layer], _points(item.outline)


def _points(line: Polyline2D | Polyline3D) -> Float64[np.ndarray, "V D"]:
    return np.asarray(line.array, dtype=np.float64)


def _pieces(line: Float64[np.ndarray, "V 3"]) -> list[Float64[np.ndarray, "v 3"]]:
    """Cut a line into pieces of at most VERTICES, and keep those that come within RADIUS_M."""
    # Neighbouring pieces share a vertex, so that there is no gap between them
    cuts = [line[start : start + VERTICES] for start in range(0, max(len(line) - 1, 1), VERTICES - 1)]
    return [piece for piece in cuts if (np.linalg.norm(piece[:, :2], axis=-1) <= RADIUS_M).any()]
