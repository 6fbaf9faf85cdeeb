"""Figures of detections and tracks under every protocol, by flat keys."""

import math
from collections.abc import Mapping
from pathlib import Path

from foredrive.evaluation.objects.log_truth import read_log_truth
from foredrive.evaluation.objects.nuscenes_json import (
    ObjectTask,
    boxes_by_frame,
    read_json_truth,
    read_object,
    read_results,
)
from foredrive.evaluation.objects.nuscenes_tables import find_tables, read_tables_truth
from foredrive.evaluation.objects.truth import FoundObjects, ObjectTruth
from foredrive.evaluation.summary import Figures
from foredrive.metrics.detection_protocols import (
    DETECTION_PROTOCOLS,
    ERRORS,
    DetectionFigures,
    evaluate_detections,
)
from foredrive.metrics.object_rows import Frames, ObjectRows
from foredrive.metrics.tracking.protocols import TRACKING_PROTOCOLS, evaluate_tracking

_NEEDED_BY = {"ave_mps": "velocity", "aae": "attribute"}
"""Column of the ground truth without which an error cannot be judged."""
_TRACKING_NAMES = {
    "amotp": "amotp_m",
    "motp": "motp_m",
    "faf": "faf_per_100_frames",
    "tid": "tid_s",
    "lgd": "lgd_s",
}
"""The devkit's names of figures with a unit, with it."""


def read_objects(results: Path, truth: Path, task: ObjectTask) -> tuple[FoundObjects, ObjectTruth]:
    """Read a results file of nuScenes and its ground truth: JSON, nuScenes' tables, or 123D logs.

    Raises:
        InputError: a file cannot be read, or a box is wrong; the message names the first.
    """
    protocol = (DETECTION_PROTOCOLS if task == "detection" else TRACKING_PROTOCOLS)["nuscenes"]
    if truth.is_file():
        true = read_json_truth(truth, task, protocol.classes)
    else:
        listed = boxes_by_frame(results, read_object(results))
        tables = find_tables(truth)
        if tables is None:
            true = read_log_truth(truth, listed, results, protocol.classes)
        else:
            true = read_tables_truth(tables, listed, results, task, protocol.classes)
    found = read_results(results, true, truth, task, protocol.classes, protocol.max_boxes)
    return found, true


def score_detections(found: FoundObjects, truth: ObjectTruth) -> Figures:
    """Return the figures of detections under every protocol.

    What the ground truth lacks is None: an error that it cannot judge, and with it NDS.
    """
    figures = detection_figures(found.boxes, truth.boxes, truth.racks, truth.lacks)
    return _counts(found, truth) | {f"detection.{key}": value for key, value in figures.items()}


def detection_figures(
    found: ObjectRows, true: ObjectRows, racks: ObjectRows, lacks: frozenset[str]
) -> Figures:
    """Return `nuscenes.map`, `nuscenes.car.ap_2m`, `vad.nds`, … of detections.

    Args:
        found, true: labels are indices into nuScenes' ten classes.
        racks: bicycle racks, in which bicycles do not count.
        lacks: columns of `ObjectTruth.lacks`. The figures that need them are None.
    """
    figures: Figures = {}
    for name, protocol in DETECTION_PROTOCOLS.items():
        scored = evaluate_detections(found, true, racks, protocol)
        judged = _judged_figures(scored, lacks)
        figures |= {f"{name}.{key}": value for key, value in judged.items()}
    return figures


def score_tracks(found: FoundObjects, truth: ObjectTruth) -> Figures:
    """Return the figures of tracks under every protocol; None where nothing can be counted."""
    figures = tracking_figures(found.boxes, truth.boxes, truth.racks, truth.frames)
    return _counts(found, truth) | {f"tracking.{key}": value for key, value in figures.items()}


def tracking_figures(found: ObjectRows, true: ObjectRows, racks: ObjectRows, frames: Frames) -> Figures:
    """Return `nuscenes.amota`, `nuscenes.car.ids`, `uniad.amota`, … of tracks.

    Args:
        found, true: labels are indices into nuScenes' seven classes.
        racks: bicycle racks, in which bicycles do not count.
        frames: all frames, in the order of time within each scene.
    """
    figures: Figures = {}
    for name, protocol in TRACKING_PROTOCOLS.items():
        scored = evaluate_tracking(found, true, racks, frames, protocol)
        figures |= _prefixed(name, scored.all_classes)
        for label, values in scored.by_class.items():
            if values["gt"] > 0:
                figures |= _prefixed(f"{name}.{label}", values)
    return figures


def _counts(found: FoundObjects, truth: ObjectTruth) -> Figures:
    return {
        "frames_counted": len(truth.names),
        "scenes": len(set(truth.frames.scene.tolist())),
        "frames_without_results": found.frames_without_results,
        "objects": len(truth.boxes),
        "found": len(found.boxes),
        "truth_lacks": ", ".join(sorted(truth.lacks)) or None,
    }


def _judged_figures(scored: DetectionFigures, lacks: frozenset[str]) -> Mapping[str, float | None]:
    judged = {key: _NEEDED_BY.get(key) not in lacks for key in ERRORS}
    figures: dict[str, float | None] = {
        "map": scored.mean_ap,
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


def _prefixed(prefix: str, values: Mapping[str, float]) -> Figures:
    return {
        f"{prefix}.{_TRACKING_NAMES.get(key, key)}": None if math.isnan(value) else value
        for key, value in values.items()
    }
