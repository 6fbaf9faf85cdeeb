"""Figures of detections under every protocol, by flat keys."""

import math
from collections.abc import Mapping

from foredrive.engine.summary import Figures
from foredrive.tasks.detection.protocols import (
    DETECTION_PROTOCOLS,
    ERRORS,
    DetectionFigures,
    evaluate_detections,
)
from foredrive.tasks.objects.object_rows import ObjectRows
from foredrive.tasks.objects.truth import FoundObjects, ObjectTruth, count_objects

_NEEDED_BY = {"ave_mps": "velocity", "aae": "attribute"}
"""Column of the ground truth without which an error cannot be judged."""


def score_objects(predicted: FoundObjects, truth: ObjectTruth) -> Figures:
    """Return the figures of detections under every protocol.

    What the ground truth lacks is None: an error that it cannot judge, and with it NDS.
    """
    figures = detection_figures(predicted.boxes, truth.boxes, truth.racks, truth.lacks)
    return count_objects(predicted, truth) | {f"detection.{key}": value for key, value in figures.items()}


def detection_figures(
    predicted: ObjectRows, true: ObjectRows, racks: ObjectRows, lacks: frozenset[str]
) -> Figures:
    """Return `nuscenes.map`, `nuscenes.car.ap_2m`, `vad.nds`, … of detections.

    Args:
        predicted, true: labels are indices into nuScenes' ten classes.
        racks: bicycle racks, in which bicycles do not count.
        lacks: columns of `ObjectTruth.lacks`. The figures that need them are None.
    """
    figures: Figures = {}
    for name, protocol in DETECTION_PROTOCOLS.items():
        scored = evaluate_detections(predicted, true, racks, protocol)
        judged = _judged_figures(scored, lacks)
        figures |= {f"{name}.{key}": value for key, value in judged.items()}
    return figures


def _judged_figures(scored: DetectionFigures, lacks: frozenset[str]) -> Mapping[str, float | None]:
    judged = {key: _NEEDED_BY.get(key) not in lacks for key in ERRORS}
    figures: dict[str, float | None] = {
        "map": scored.mean_ap,
        # NDS needs all errors
        "nds": scored.nds if all(judged.values()) else None,
        **{key: scored.errors[key] if judged[key] else None for key in ERRORS},
    }
    for label, of_class in scored.by_class.items():
        if of_class.true == 0:
            continue
        figures[f"{label}.ap"] = sum(of_class.ap.values()) / len(of_class.ap)
        for distance, ap in of_class.ap.items():
            figures[f"{label}.ap_{distance:g}m"] = ap
        for key, error in of_class.errors.items():
            if judged[key] and not math.isnan(error):
                figures[f"{label}.{key}"] = error
    return figures
