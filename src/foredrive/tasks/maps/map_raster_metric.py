"""The metric of maps as raster layers, under UniAD's protocol, beside the training set's best mask.

The IoU is that of OpenDriveLab/UniAD, dense_heads/panseg_head.py (`IOU`) and
nuscenes_e2e_dataset.py, which sums intersections and unions over the data set.
`data.truth.map_elements.read_map_raster` draws the truth.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from foredrive.heads.plane import cell_middles
from foredrive.scene import Example
from foredrive.scene.map_elements import RasterLayer
from foredrive.tasks.metric import PRIOR, EvaluationContext, Figures, Shown
from foredrive.tasks.predictor import Part, Prediction

FIGURES = ("lanes", "drivable", "divider", "crossing", "boundary")
"""Names of the reported classes. `lanes` is the union of the three layers of lines; `boundary` is UniAD's
contour."""


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
    # The layers in the order of their numbers
    divider, crossing, boundary, drivable = (masks[:, layer] for layer in sorted(RasterLayer))
    return divider | crossing | boundary, drivable, divider, crossing, boundary


class MapRasterMetric:
    """Keys: `uniad.iou_lanes`, `uniad.iou_lanes.best_constant` and so on; `raster.frames_counted`.

    `uniad_covered.iou_lanes` counts only cells above the clips' voxels: a small model cannot see the others.
    The baseline is the mask that fits the maps of the training set best. Frames without a map do not count.
    """

    name = "map"
    title = "Map"
    shown: tuple[Shown, ...] = (
        Shown("UniAD, IoU of lanes", "uniad.iou_lanes", PRIOR),
        Shown("UniAD, IoU of the drivable area", "uniad.iou_drivable", PRIOR),
    )
    needs: frozenset[Part] = frozenset({"map_layers"})

    def __init__(self, context: EvaluationContext) -> None:
        self._prior = None if context.task_priors is None else context.task_priors.layers
        self._counts: dict[tuple[str, str], RasterCounts] = {}
        """By area and suffix of the figures."""

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips."""
        layers, raster = prediction.map_layers, None if truth.truth is None else truth.truth.raster
        if layers is None or raster is None or not bool(raster.known.any()):
            return
        # Only frames with a map
        true = raster.layers[raster.known].cpu().numpy()
        shown = {"": (layers[raster.known] > 0.5).cpu().numpy()}
        if self._prior is not None:
            shown[f".{PRIOR}"] = self._prior.cpu().expand(len(true), -1, -1, -1).numpy()
        # All cells, and those above the voxels, which a model with a small grid can see
        spec = raster.spec
        middle_m = cell_middles(spec.lower_m, spec.cell_m, spec.shape_yx)
        covered = truth.occupancy.spec.covers(middle_m).view(spec.shape_yx).numpy()
        areas = {"uniad": np.array(True), "uniad_covered": covered}
        for suffix, mask in shown.items():
            for area, cells in areas.items():
                counts, key = count_raster(mask & cells, true & cells), (area, suffix)
                # Sums over all frames: IoU is the ratio of sums, not a mean of ratios
                self._counts[key] = self._counts[key] + counts if key in self._counts else counts

    def result(self) -> Figures:
        """Return the ratios of the sums."""
        out: Figures = {}
        for (area, suffix), counts in self._counts.items():
            out |= {f"{area}.{key}{suffix}": value for key, value in raster_figures(counts).items()}
            out["raster.frames_counted"] = counts.frames
        return out
