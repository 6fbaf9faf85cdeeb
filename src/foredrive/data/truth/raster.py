"""Drawing of polygons and lines on a grid in the plane of the ego frame, cell for cell as UniAD's truth."""

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from jaxtyping import Float64, Int32, UInt8

from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene.map_elements import PlaneSpec

LINE_STEP_M = 1.0
"""UniAD samples lines at this distance from their start before it draws them. A shorter rest is lost."""


def fill_polygon(
    rings: Sequence[Float64[np.ndarray, "_ _"]], value: int, spec: PlaneSpec, out_yx: Int32[np.ndarray, "Y X"]
) -> None:
    """Write a value into the cells of a polygon, changed in place.

    They are those of OpenCV's `fillPoly` with vertices rounded to the nearest border of cells, as in UniAD's
    `GenerateOccFlowLabels`. The outline is drawn too, so an area is about a cell larger in each direction.

    Args:
        rings: the outline and the holes, ego frame, m.
        value: number to write.
        spec: the grid.
        out_yx: the cells.
    """
    # OpenCV draws between whole numbers: vertices go to the nearest border of cells
    cells = [np.round(_in_cells(ring, spec)).astype(np.int32) for ring in rings]
    cv2.fillPoly(out_yx, cells, value)


def draw_lines(
    lines: Iterable[Float64[np.ndarray, "_ _"]], width_px: int, spec: PlaneSpec
) -> UInt8[np.ndarray, "Y X"]:
    """Return a mask of polylines (ego frame, m), drawn by OpenCV as in UniAD's `preprocess_map`.

    Vertices are rounded down to cells.
    """
    mask = np.zeros(spec.shape_yx, dtype=np.uint8)
    for line in lines:
        flat = line[:, :2]
        along = arc_lengths(flat)
        # Points at whole steps from the start; the rest of the line is lost, as in UniAD
        sampled = points_at(flat, along, np.arange(0.0, along[-1], LINE_STEP_M))
        if len(sampled) > 1:
            cells = np.trunc(_in_cells(sampled, spec)).astype(np.int32)
            cv2.polylines(mask, [cells], isClosed=False, color=1, thickness=width_px)
    return mask


def _in_cells(points: Float64[np.ndarray, "V _"], spec: PlaneSpec) -> Float64[np.ndarray, "V 2"]:
    """Return x and y of points in cells from the grid's lower corner."""
    return (points[:, :2] - np.asarray(spec.lower_m)) / spec.cell_m
