"""The detection protocols in use on nuScenes, as data, and their figures.

Facts read in the public code:
- nuScenes: nuscenes-devkit 1.2.0, eval/detection (algo.py, data_classes.py), eval/common/utils.py,
  detection_cvpr_2019.json
- VAD: hustvl/VAD, datasets/vad_custom_nuscenes_eval.py (filter_eval_boxes),
  vad_nusc_detection_cvpr_2019.json. It counts boxes within ±30 m and ±15 m along two axes. The axes are those
  of the world, as `ego_translation` is, while the code that writes VAD's results keeps boxes by the same
  limits along the axes of the ego vehicle. Here the file is taken as it is.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.scene.boxes import UNKNOWN
from foredrive.tasks.objects.matching import (
    NUSCENES_DISTANCES_M,
    descending,
    match_centres,
    mean_of_valid,
    ranked_precision_nuscenes,
)
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES, MAX_BOXES, ObjectRows, Region, counted

ERRORS = ("ate_m", "ase", "aoe_rad", "ave_mps", "aae")
"""Errors of translation, scale (1 - overlap of sizes), orientation, velocity, attribute (1 - accuracy)."""


@dataclass(frozen=True)
class DetectionProtocol:
    """The choices that define a detection protocol."""

    title: str
    classes: tuple[str, ...]
    region: Region
    distances_m: tuple[float, ...]
    """Distances of centres over ground below which a detection hits; average precision is their mean."""
    error_distance_m: float
    """The one of them at which errors are taken."""
    half_turn: frozenset[str]
    """Classes whose front and back look alike."""
    without: Mapping[str, frozenset[str]]
    """Errors that are not defined for a class."""
    map_weight: float
    """Weight of mAP in NDS; each error's score has weight 1."""
    max_boxes: int
    """Maximum number of detections in a frame of a results file."""


_REACH_M: Final = {
    **dict.fromkeys(("car", "truck", "bus", "trailer", "construction_vehicle"), (50.0, 50.0)),
    **dict.fromkeys(("pedestrian", "motorcycle", "bicycle"), (40.0, 40.0)),
    **dict.fromkeys(("traffic_cone", "barrier"), (30.0, 30.0)),
}


def _nuscenes(title: str, region: Region) -> DetectionProtocol:
    return DetectionProtocol(
        title=title,
        classes=DETECTION_CLASSES,
        region=region,
        distances_m=NUSCENES_DISTANCES_M,
        error_distance_m=2.0,
        half_turn=frozenset({"barrier"}),
        without={
            "traffic_cone": frozenset({"aoe_rad", "ave_mps", "aae"}),
            "barrier": frozenset({"ave_mps", "aae"}),
        },
        map_weight=5.0,
        max_boxes=MAX_BOXES,
    )


DETECTION_PROTOCOLS: Mapping[str, DetectionProtocol] = {
    "nuscenes": _nuscenes("nuScenes", Region("circle", _REACH_M)),
    "vad": _nuscenes("VAD", Region("rectangle", dict.fromkeys(DETECTION_CLASSES, (30.0, 15.0)))),
}


@dataclass(frozen=True)
class ClassFigures:
    """Figures of one class."""

    ap: Mapping[float, float]
    """Average precision at each distance, m."""
    errors: Mapping[str, float]
    """`ERRORS` of hits; NaN where the class has none defined."""
    true: int
    """Number of true boxes that the protocol counts."""


@dataclass(frozen=True)
class DetectionFigures:
    """Figures of one protocol."""

    by_class: Mapping[str, ClassFigures]
    mean_ap: float
    """Mean over classes and distances. A class without true boxes has 0."""
    errors: Mapping[str, float]
    """Means over the classes for which each is defined. A class of which nothing is found has 1."""
    nds: float
    """nuScenes detection score: mean of mAP (weight 5) and of 1 - error, at least 0 (weight 1 each)."""


def evaluate_detections(
    predicted: ObjectRows, true: ObjectRows, racks: ObjectRows, protocol: DetectionProtocol
) -> DetectionFigures:
    """Return the figures of detections under one protocol.

    Args:
        predicted: in the order of the file: among equal scores the later detection comes first.
        true, predicted: labels are indices into the protocol's classes; -1 is left out.
        racks: bicycle racks; labels do not matter.
    """
    # Boxes that the protocol counts: in range, with points, not at a bicycle rack
    predicted, true = (
        boxes[(boxes.label >= 0) & counted(boxes, racks, protocol.region, protocol.classes)]
        for boxes in (predicted, true)
    )
    by_class = {
        name: _class_figures(predicted[predicted.label == n], true[true.label == n], name, protocol)
        for n, name in enumerate(protocol.classes)
    }
    # Classes without true boxes count with 0; NaN errors of undefined classes do not count
    mean_ap = float(np.mean([np.mean([*figures.ap.values()]) for figures in by_class.values()]))
    errors = {key: mean_of_valid([figures.errors[key] for figures in by_class.values()]) for key in ERRORS}
    # NDS: weighted mean of mAP and of 1 - error of each kind
    score = protocol.map_weight * mean_ap + sum(max(0.0, 1.0 - error) for error in errors.values())
    return DetectionFigures(by_class, mean_ap, errors, score / (protocol.map_weight + len(ERRORS)))


def _class_figures(
    predicted: ObjectRows, true: ObjectRows, name: str, protocol: DetectionProtocol
) -> ClassFigures:
    # The devkit's order: descending score, equal scores from the end of the file
    predicted = predicted[descending(predicted.score, ties_reversed=True)]
    partners = match_centres(
        predicted.frame,
        predicted.centre[:, :2],
        true.frame,
        true.centre[:, :2],
        protocol.distances_m,
    )
    ap = {
        # A class without true boxes has average precision 0 in the devkit.
        distance: ranked_precision_nuscenes(partner >= 0, len(true)) if len(true) else 0.0
        for distance, partner in zip(protocol.distances_m, partners, strict=True)
    }
    # Errors are those of the hits at one distance
    partner = partners[protocol.distances_m.index(protocol.error_distance_m)]
    errors = _mean_errors(predicted, true, partner, name, protocol)
    undefined = dict.fromkeys(protocol.without.get(name, ()), math.nan)
    return ClassFigures(ap, errors | undefined, len(true))


def _mean_errors(
    predicted: ObjectRows,
    true: ObjectRows,
    partner: Int[ndarray, "m"],
    name: str,
    protocol: DetectionProtocol,
) -> dict[str, float]:
    """Return each error of the hits, averaged over recall. Detections are in order of falling score."""
    hit = partner >= 0
    errors = hit_errors(predicted[hit], true[partner[hit]], half_turn=name in protocol.half_turn)
    return {key: error_over_recall(predicted.score, hit, len(true), error) for key, error in errors.items()}


def hit_errors(
    predicted: ObjectRows, true: ObjectRows, *, half_turn: bool = False
) -> dict[str, Float[ndarray, "n"]]:
    """Return `ERRORS` of pairs. NaN: the velocity is unknown, or the true box has no attribute."""
    # Overlap of aligned boxes: the smaller of each dimension
    smaller, a, b = (
        size.prod(axis=1)
        for size in (np.minimum(predicted.size_lwh, true.size_lwh), predicted.size_lwh, true.size_lwh)
    )
    # Difference of headings to half a period; fronts and backs of barriers look alike
    period = math.pi if half_turn else 2 * math.pi
    turn = np.abs((true.yaw - predicted.yaw + period / 2) % period - period / 2)
    wrong = np.where(predicted.attribute == true.attribute, 0.0, 1.0)
    return {
        "ate_m": np.linalg.norm(predicted.centre[:, :2] - true.centre[:, :2], axis=1),
        "ase": 1.0 - smaller / (a + b - smaller),
        "aoe_rad": turn,
        "ave_mps": np.linalg.norm(predicted.velocity - true.velocity, axis=1),
        # A box without a known attribute has no attribute error
        "aae": np.where(true.attribute == UNKNOWN, np.nan, wrong),
    }


FIRST = 11
"""Recall 0.11, the first of 101 steps that counts: the devkit leaves out the step of its minimum, 0.1."""


def error_over_recall(
    score: Float[ndarray, "M"], hit: Bool[ndarray, "M"], objects: int, error: Float[ndarray, "H"]
) -> float:
    """Return the mean error of the hits over recall; 1 without a hit, or if recall stays below 0.11.

    At each step of recall it is the running mean over the hits, the best scored first, read at the score
    that this recall is reached with (nuscenes-devkit, eval/detection/algo.py, `accumulate` and `calc_tp`).

    Args:
        score, hit: of the predictions, in order of descending score.
        error: of the hits, in the same order. NaN where it is not known.
    """
    if not hit.any():
        return 1.0
    # Recall after each prediction
    recall = np.cumsum(hit) / objects
    # Score at which each of 101 recalls is reached; 0 beyond the largest one
    at_recall = np.interp(np.linspace(0, 1, 101), recall, score, right=0.0)
    # Running mean error as a function of the score; np.interp needs ascending scores, hence the reversals
    curve = np.interp(at_recall[::-1], score[hit][::-1], running_mean(error)[::-1])[::-1]
    # Steps from recall 0.11 to the largest recall that is reached
    reached = np.flatnonzero(at_recall)
    last = int(reached[-1]) if len(reached) else 0
    return float(curve[FIRST : last + 1].mean()) if last >= FIRST else 1.0


def running_mean(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Return the mean of the known values so far: 0 before the first, 1 everywhere if none is known."""
    # Unknown errors count neither in the sum nor in the number
    valid: Bool[ndarray, n] = ~np.isnan(values)
    if not valid.any():
        return np.ones(len(values))
    count = np.cumsum(valid)
    return np.divide(np.nancumsum(values), count, out=np.zeros(len(values)), where=count > 0)
