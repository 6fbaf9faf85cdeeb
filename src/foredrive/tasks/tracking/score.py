"""Figures of detections and tracks under every protocol, by flat keys."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from foredrive.engine.summary import Figures
from foredrive.tasks.detection.nuscenes_results import boxes_by_frame
from foredrive.tasks.detection.protocols import (
    DETECTION_PROTOCOLS,
    ERRORS,
    DetectionFigures,
    evaluate_detections,
)
from foredrive.tasks.evaluation.frames_of_results import annotated_frames
from foredrive.tasks.tracking.in_world import box_rows, stacked
from foredrive.tasks.tracking.nuscenes_json import (
    ObjectTask,
    read_json_truth,
    read_object,
    read_results,
    with_places_of_results,
)
from foredrive.tasks.tracking.nuscenes_tables import find_tables, read_tables_truth
from foredrive.tasks.tracking.object_rows import Frames, ObjectRows
from foredrive.tasks.tracking.protocols import TRACKING_PROTOCOLS, evaluate_tracking
from foredrive.tasks.tracking.truth import FoundObjects, ObjectTruth, lacking


def read_log_truth(folder: Path, listed: Iterable[str], path: Path, classes: Sequence[str]) -> ObjectTruth:
    """Read the boxes of logs, in their world frame, at the frames that a results file lists.

    Other frames of the logs are not evaluated: results are mostly of fewer frames than a log has.

    Args:
        folder: with logs, as `find_logs` takes it.
        listed: names of frames.
        path: of the results, for messages.

    Raises:
        InputError: a frame is not in the logs, or not annotated.
    """
    wanted = dict.fromkeys(listed)
    names: list[str] = []
    # Frames of the log have the log's world frame, so places of one drive are comparable
    rows, ego, scene, time_us = [], [], [], []
    for named, boxes in annotated_frames(folder, wanted, path):
        T_world_ego = named.log.T_world_ego[named.frame]
        rows.append(box_rows(boxes, T_world_ego, len(names), classes))
        names.append(named.name)
        ego.append(T_world_ego[:2, 3])
        scene.append(named.drive)
        time_us.append(int(named.log.t_us[named.frame]))
    every = stacked(rows)
    return ObjectTruth(
        names,
        every,
        every[np.zeros(0, np.int64)],
        Frames(np.array(scene, dtype=np.int64), np.array(time_us, dtype=np.int64)),
        np.array(ego).reshape(-1, 2),
        lacking(every),
    )


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
    if np.isnan(true.ego).any():
        true = with_places_of_results(true, results)
    predicted = read_results(results, true, truth, task, protocol.classes, protocol.max_boxes)
    return predicted, true


def score_detections(predicted: FoundObjects, truth: ObjectTruth) -> Figures:
    """Return the figures of detections under every protocol.

    What the ground truth lacks is None: an error that it cannot judge, and with it NDS.
    """
    figures = detection_figures(predicted.boxes, truth.boxes, truth.racks, truth.lacks)
    return _counts(predicted, truth) | {f"detection.{key}": value for key, value in figures.items()}


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


def score_tracks(predicted: FoundObjects, truth: ObjectTruth) -> Figures:
    """Return the figures of tracks under every protocol; None where nothing can be counted."""
    figures = tracking_figures(predicted.boxes, truth.boxes, truth.racks, truth.frames)
    return _counts(predicted, truth) | {f"tracking.{key}": value for key, value in figures.items()}


def tracking_figures(predicted: ObjectRows, true: ObjectRows, racks: ObjectRows, frames: Frames) -> Figures:
    """Return `nuscenes.amota`, `nuscenes.car.ids`, `uniad.amota`, … of tracks.

    Args:
        predicted, true: labels are indices into nuScenes' seven classes.
        racks: bicycle racks, in which bicycles do not count.
        frames: all frames, in the order of time within each scene.
    """
    figures: Figures = {}
    for name, protocol in TRACKING_PROTOCOLS.items():
        scored = evaluate_tracking(predicted, true, racks, frames, protocol)
        figures |= _prefixed(name, scored.all_classes)
        for label, values in scored.by_class.items():
            # Classes without ground truth have no figures
            if values["gt"] > 0:
                figures |= _prefixed(f"{name}.{label}", values)
    return figures


def _counts(predicted: FoundObjects, truth: ObjectTruth) -> Figures:
    return {
        "frames_counted": len(truth.names),
        "scenes": len(set(truth.frames.scene.tolist())),
        "frames_without_results": predicted.frames_without_results,
        "objects": len(truth.boxes),
        "found": len(predicted.boxes),
        "truth_lacks": ", ".join(sorted(truth.lacks)) or None,
    }


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


def _prefixed(prefix: str, values: Mapping[str, float]) -> Figures:
    return {
        f"{prefix}.{_TRACKING_NAMES.get(key, key)}": None if math.isnan(value) else value
        for key, value in values.items()
    }
