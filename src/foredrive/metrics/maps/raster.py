"""Masks of map elements, and their intersection over union."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.metrics.maps.lines import CLASSES
from foredrive.metrics.maps.protocols import RasterProtocol
from foredrive.scene.map_elements import ElementKind

LAYERS = ("divider", "crossing", "boundary", "drivable")
"""Layers of the masks that are compared: the classes of lines in UniAD's order, and the drivable area."""
FIGURES = ("lanes", "drivable", "divider", "crossing", "boundary")
"""What is reported. `lanes` is the union of the three classes of lines, and `boundary` UniAD's contour."""


@dataclass(frozen=True)
class RasterCounts:
    """Cells in both masks and in either, summed over frames, in the order of `FIGURES`."""

    intersection: Int[ndarray, "5"]
    union: Int[ndarray, "5"]
    frames: int

    def __add__(self, other: "RasterCounts") -> "RasterCounts":
        return RasterCounts(
            self.intersection + other.intersection, self.union + other.union, self.frames + other.frames
        )


def count_raster(predicted: Bool[ndarray, "F 4 H W"], true: Bool[ndarray, "F 4 H W"]) -> RasterCounts:
    """Count the cells of masks with the layers `LAYERS`."""
    both, either = [], []
    for mask, other in zip(_figure_masks(predicted), _figure_masks(true), strict=True):
        both.append((mask & other).sum())
        either.append((mask | other).sum())
    return RasterCounts(np.array(both), np.array(either), len(predicted))


def raster_figures(counts: RasterCounts) -> dict[str, float]:
    """Return `iou_lanes`, … of the sums over all frames; NaN where neither mask has a cell."""
    ious = np.divide(
        counts.intersection, counts.union, out=np.full(len(FIGURES), np.nan), where=counts.union > 0
    )
    return {f"iou_{name}": float(iou) for name, iou in zip(FIGURES, ious, strict=True)}


def draw_lines(
    lines: Sequence[Float[ndarray, "_ 2"]], kinds: Sequence[int], protocol: RasterProtocol
) -> Bool[ndarray, "3 H W"]:
    """Draw polylines (ego frame, m) as the protocol's truth is drawn: one mask a class of `CLASSES`.

    Rows are along y and columns along x, both ascending from the corner behind the vehicle to its right.
    """
    masks = np.stack([_drawn(_of_kind(lines, kinds, kind), protocol, protocol.width_px) for kind in CLASSES])
    for later, kind in reversed(list(enumerate(CLASSES))):
        masks[:later] &= ~_drawn(_of_kind(lines, kinds, kind), protocol, protocol.clear_px)
    return masks


def _figure_masks(masks: Bool[ndarray, "F 4 H W"]) -> tuple[Bool[ndarray, "F H W"], ...]:
    divider, crossing, boundary, drivable = masks.swapaxes(0, 1)
    return divider | crossing | boundary, drivable, divider, crossing, boundary


def _of_kind(
    lines: Sequence[Float[ndarray, "_ 2"]], kinds: Sequence[int], kind: ElementKind
) -> list[Float[ndarray, "_ 2"]]:
    return [line for line, of in zip(lines, kinds, strict=True) if of == kind]


def _drawn(
    lines: Sequence[Float[ndarray, "_ 2"]], protocol: RasterProtocol, width_px: int
) -> Bool[ndarray, "H W"]:
    image: UInt8[ndarray, "H W"] = np.zeros((protocol.cells, protocol.cells), dtype=np.uint8)
    half_m, cells_per_m = protocol.side_m / 2, protocol.cells / protocol.side_m
    patch = shapely.box(-half_m, -half_m, half_m, half_m)
    for line in lines:
        arc_m = arc_lengths(line)
        points = points_at(line, arc_m, np.arange(0.0, arc_m[-1], protocol.step_m))
        if len(points) < 2:
            continue
        inside = shapely.intersection(shapely.LineString(points), patch)
        for part in shapely.get_parts(inside):
            corners = ((shapely.get_coordinates(part) + half_m) * cells_per_m).astype(np.int32)
            if len(corners) >= 2:
                cv2.polylines(image, [corners], isClosed=False, color=1, thickness=width_px)
    return image.astype(bool)
