"""Intersection over union of masks of map elements, as UniAD counts it.

Source: OpenDriveLab/UniAD, dense_heads/panseg_head.py (`IOU`) and nuscenes_e2e_dataset.py, which sums
intersections and unions over the data set. `data.map_elements.read_map_raster` draws the truth.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from foredrive.scene.map_elements import RasterLayer

FIGURES = ("lanes", "drivable", "divider", "crossing", "boundary")
"""What is reported. `lanes` is the union of the three layers of lines, and `boundary` UniAD's contour."""


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
    """Count the cells of masks with the layers of `RasterLayer`."""
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


def _figure_masks(masks: Bool[ndarray, "F 4 H W"]) -> tuple[Bool[ndarray, "F H W"], ...]:
    divider, crossing, boundary, drivable = (masks[:, layer] for layer in sorted(RasterLayer))
    return divider | crossing | boundary, drivable, divider, crossing, boundary
