"""The metric of maps as polylines, under the protocols of vectors."""

import numpy as np
import shapely
from jaxtyping import Float64
from numpy import ndarray

from foredrive.engine.summary import Figures
from foredrive.scene import Example, VoxelSpec
from foredrive.scene.map_elements import ElementKind
from foredrive.tasks.maps.lines import CLASSES, LineSet
from foredrive.tasks.maps.precision import mean_precision, score_maps
from foredrive.tasks.maps.protocols import PROTOCOLS, Area
from foredrive.tasks.metric import CEILING, EvaluationContext, Shown
from foredrive.tasks.predictor import Part, Prediction

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
