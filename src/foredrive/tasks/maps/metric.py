"""Maps: polylines under the protocols of vectors, raster layers under UniAD's, beside the training set's.

The IoU of raster layers is that of OpenDriveLab/UniAD, dense_heads/panseg_head.py (`IOU`) and
nuscenes_e2e_dataset.py, which sums intersections and unions over the data set.
`data.truth.map_elements.read_map_raster` draws the truth.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int
from numpy import ndarray

from foredrive.heads.plane import cell_middles
from foredrive.scene import Example, VoxelSpec
from foredrive.scene.map_elements import ElementKind, RasterLayer
from foredrive.tasks.evaluation.metric import CEILING, PRIOR, EvaluationContext, Figures, Shown
from foredrive.tasks.evaluation.predictor import Part, Prediction
from foredrive.tasks.maps.lines import CLASSES, LineSet
from foredrive.tasks.maps.precision import mean_precision, score_maps
from foredrive.tasks.maps.protocols import PROTOCOLS, Area

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


AREA: Area = "60x30"
"""Area in which lines are compared."""


class MapLinesMetric:
    """Keys: `maptr.map`, `maptr.ap_divider`, `streammapnet.map` and so on; `lines.frames_counted`.

    `maptr.map.ceiling` is that of the true lines cut to the clips' voxels: the longest part of each, scored
    by its share of the line. A head that guesses how lines go on may exceed it.
    Protocols that follow identities are left out. Frames without a map do not count.
    """

    name = "map"
    title = "Map"
    shown: tuple[Shown, ...] = (Shown("MapTR mAP", "maptr.map", "nothing_detected"),)
    needs: frozenset[Part] = frozenset({"map_lines"})

    def __init__(self, context: EvaluationContext) -> None:
        self._found: list[tuple[int, int, ndarray, float]] = []
        self._true: list[tuple[int, int, ndarray, float]] = []
        self._above: list[tuple[int, int, ndarray, float]] = []
        """Parts of true lines above the voxels."""
        self._frames = 0

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips."""
        predicted, elements = prediction.map_lines, None if truth.truth is None else truth.truth.elements
        if predicted is None or elements is None:
            return
        for item in elements.known.nonzero()[:, 0].tolist():
            points, kinds = predicted.points[item].double().cpu().numpy(), predicted.kind[item].tolist()
            scores = predicted.score[item].tolist()
            rows = zip(kinds, points, scores, strict=True)
            self._found += [(self._frames, kind, line, score) for kind, line, score in rows]
            for number, kind in enumerate(elements.kind[item].tolist()):
                if kind in CLASSES:
                    line = (
                        elements.vertices[item, number, elements.valid[item, number]].double().cpu().numpy()
                    )
                    self._true.append((self._frames, kind, line, 1.0))
                    part, share = _part_above(line, truth.occupancy.spec)
                    self._above += [(self._frames, kind, part, share)] if share > 0 else []
            self._frames += 1

    def result(self) -> Figures:
        """Return the average precisions over all frames with a map."""
        if not self._frames:
            return {}
        # Frames are numbered over all batches
        predicted, true, above = map(_line_set, (self._found, self._true, self._above))
        out: Figures = {}
        for name, protocol in PROTOCOLS.items():
            if protocol.identity:
                continue
            scores = score_maps(predicted, true, protocol, AREA)
            out[f"{name}.map"] = mean_precision(scores, protocol)
            out[f"{name}.map.nothing_detected"] = 0.0
            out[f"{name}.map.{CEILING}"] = mean_precision(score_maps(above, true, protocol, AREA), protocol)
            out |= {
                f"{name}.ap_{ElementKind(kind).name.lower()}": predicted.ap
                for kind, predicted in scores.items()
            }
        return out | {"lines.frames_counted": self._frames}


def _part_above(line: Float64[ndarray, "V 2"], voxels: VoxelSpec) -> tuple[Float64[ndarray, "_ 2"], float]:
    """Return the longest part of a line above a voxel grid, and its share of the line's length."""
    whole = shapely.LineString(line)
    cut = shapely.box(*voxels.lower_m[:2], *voxels.upper_m[:2]).intersection(whole)
    # Shapely 2.2 cuts a closed line at its first vertex too: those two parts belong together
    parts = shapely.get_parts(shapely.line_merge(cut))
    longest = max(parts, key=lambda part: part.length, default=shapely.LineString())
    return shapely.get_coordinates(longest), longest.length / whole.length


def _line_set(rows: list[tuple[int, int, ndarray, float]]) -> LineSet:
    return LineSet(
        frame=np.array([frame for frame, *_ in rows], dtype=np.int64),
        kind=np.array([kind for _, kind, *_ in rows], dtype=np.int64),
        lines=[line for _, _, line, _ in rows],
        score=np.array([score for *_, score in rows], dtype=np.float64),
    )


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
