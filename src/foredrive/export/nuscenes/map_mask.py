"""Masks of the drivable area, as nuScenes-devkit's `MapMask` reads them."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from foredrive.data.logs import Log
from foredrive.data.map_elements import log_map, read_shared_drivable
from foredrive.data.map_lines import Line
from foredrive.export.nuscenes.tables import token

CELL_M = 0.1
"""The devkit's resolution of masks."""
MARGIN_M = 100.0
"""Distance around the driven path, or around a shared map, that a mask covers."""
MAX_CELLS = 400_000_000
"""Size of the largest mask: a square of 2 km."""


@dataclass(frozen=True)
class MapMask:
    """A mask of the drivable area, placed in the world frame."""

    token: str
    """Logs that share a map have the same mask."""
    cells: UInt8[np.ndarray, "Y X"]
    """255 on drivable ground, else 0. The first row is that of the largest y, as in an image."""
    lower_m: Float64[np.ndarray, "2"]
    """Lower corner in the world frame, in whole metres. The devkit takes it for the origin."""


def draw_map_mask(log: Log) -> MapMask:
    """Draw the drivable areas of the map that a log shares with others, else those around its path.

    A shared map is drawn whole, unless it is too large or the log leaves it. Without a map nothing is
    drivable. Around too long a path the mask has a single cell, where nothing is drivable.

    Raises:
        InputError: the map cannot be read.
    """
    driven = log.T_world_ego[:, :2, 3]
    shared = read_shared_drivable(log)
    if shared:
        corners = np.concatenate([ring[:, :2] for area in shared for ring in area])
        lower_m, size_xy = _grid(corners)
        upper_m = lower_m + size_xy * CELL_M
        if size_xy.prod() <= MAX_CELLS and (driven >= lower_m).all() and (driven <= upper_m).all():
            names = (log.metadata.dataset, log.metadata.location, *lower_m, *size_xy)
            return MapMask(token("map", *names), _drawn(shared, lower_m, size_xy), lower_m)
    lower_m, size_xy = _grid(driven)
    own = token("map", log.path.name)
    if size_xy.prod() > MAX_CELLS:
        return MapMask(own, np.zeros((1, 1), dtype=np.uint8), lower_m)
    found = log_map(log)
    return MapMask(own, _drawn([] if found is None else found.drivable, lower_m, size_xy), lower_m)


def _grid(points: Float64[np.ndarray, "N 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Return lower corner (whole metres) and size in cells of the grid around points."""
    lower_m = np.floor(points.min(axis=0) - MARGIN_M)
    upper_m = np.ceil(points.max(axis=0) + MARGIN_M)
    return lower_m, np.round((upper_m - lower_m) / CELL_M).astype(np.int64)


def _drawn(
    areas: Sequence[Sequence[Line]], lower_m: np.ndarray, size_xy: np.ndarray
) -> UInt8[np.ndarray, "Y X"]:
    cells = np.zeros(size_xy[::-1], dtype=np.uint8)
    for area in areas:
        rings = [(ring[:, :2] - lower_m) / CELL_M for ring in area]
        upside_down = [np.column_stack([ring[:, 0], len(cells) - ring[:, 1]]) for ring in rings]
        cv2.fillPoly(cells, [np.round(ring).astype(np.int32) for ring in upside_down], 255)
    return cells
