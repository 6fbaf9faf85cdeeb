"""Our figures beside those of the oracles, in their words."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.track_sequences import LEAST_SIMILARITY, Sequence, as_rows

from benchmarks.common.object_drives import Drives, detection_boxes, tracking_boxes, truth_file
from foredrive.tasks.detection.files import read_detections
from foredrive.tasks.detection.protocols import DETECTION_PROTOCOLS, evaluate_detections
from foredrive.tasks.detection.score import score_frames
from foredrive.tasks.detection.summary import summarise_scores
from foredrive.tasks.objects.nuscenes_json import read_json_truth, read_results
from foredrive.tasks.tracking.clear import Candidates, clear_mot
from foredrive.tasks.tracking.hota import hota
from foredrive.tasks.tracking.protocols import TRACKING_PROTOCOLS, evaluate_tracking

ERRORS = {
    "trans_err": "ate_m",
    "scale_err": "ase",
    "orient_err": "aoe_rad",
    "vel_err": "ave_mps",
    "attr_err": "aae",
}


def check_detection(drives: Drives, name: str, expected: dict[str, Any], folder: Path) -> None:
    """Fail unless every figure of the detection task is the devkit's, through the files that users have."""
    protocol = DETECTION_PROTOCOLS[name]
    results, truth = folder / "results.json", folder / "truth.json"
    boxes = {token: detection_boxes(each) for token, each in drives.detections.items()}
    results.write_text(json.dumps({"meta": {}, "results": boxes}))
    truth.write_text(json.dumps(truth_file(drives)))
    true = read_json_truth(truth, "detection", protocol.classes)
    found = read_results(results, true, truth, "detection", protocol.classes, protocol.max_boxes)
    ours = evaluate_detections(found.boxes, true.boxes, true.racks, protocol)
    assert ours.mean_ap == pytest.approx(expected["mean_ap"], abs=1e-9)
    assert ours.nds == pytest.approx(expected["nd_score"], abs=1e-9)
    for theirs, key in ERRORS.items():
        assert ours.errors[key] == pytest.approx(expected["tp_errors"][theirs], abs=1e-9)
    for label, figures in ours.by_class.items():
        assert list(figures.ap.values()) == pytest.approx(
            list(expected["label_aps"][label].values()), abs=1e-9
        )
        for theirs, key in ERRORS.items():
            assert figures.errors[key] == pytest.approx(
                expected["label_tp_errors"][label][theirs], abs=1e-9, nan_ok=True
            )
    if name == "nuscenes":
        check_precision_of_sets(results, truth, expected)


def check_precision_of_sets(results: Path, truth: Path, expected: dict[str, Any]) -> None:
    """Fail unless average precision beside the likelihood of sets is the devkit's, by class."""
    read = read_detections(results, truth)
    figures = summarise_scores(read, score_frames(read)).figures
    for label in read.classes[: read.true_classes]:
        precisions = list(expected["label_aps"][label].values())
        assert figures[f"ap.{label}"] == pytest.approx(np.mean(precisions), abs=1e-9)


def check_tracking(drives: Drives, name: str, expected: dict[str, Any], folder: Path) -> None:
    """Fail unless every figure of the tracking task is the devkit's: counts equal, the others to 1e-6."""
    protocol = TRACKING_PROTOCOLS[name]
    results, truth = folder / "results.json", folder / "truth.json"
    boxes = {token: tracking_boxes(each, protocol.classes) for token, each in drives.tracks.items()}
    results.write_text(json.dumps({"meta": {}, "results": boxes}))
    truth.write_text(json.dumps(truth_file(drives)))
    true = read_json_truth(truth, "tracking", protocol.classes)
    found = read_results(results, true, truth, "tracking", protocol.classes, protocol.max_boxes)
    ours = evaluate_tracking(found.boxes, true.boxes, true.racks, true.frames, protocol)
    counts = {"gt", "tp", "fp", "fn", "ids", "frag", "mt", "ml"}
    for key, value in ours.all_classes.items():
        assert value == pytest.approx(expected[key], abs=1e-6, nan_ok=True), key
    for label, figures in ours.by_class.items():
        for key, value in figures.items():
            theirs = expected["label_metrics"][key][label]
            slack = 0.0 if key in counts else 1e-6
            assert value == pytest.approx(theirs, abs=slack, nan_ok=True), (label, key)


def check_clear(sequence: Sequence, expected: dict[str, float]) -> None:
    """Fail unless CLEAR MOT is that of motmetrics."""
    true, found, similar = as_rows(sequence, LEAST_SIMILARITY)
    near = Candidates(similar.true_row, similar.found_row, 1 - similar.value)
    _, counts = clear_mot(true, found, near)
    assert counts.matches == expected["num_matches"]
    assert counts.switches == expected["num_switches"]
    assert counts.misses == expected["num_misses"]
    assert counts.false == expected["num_false_positives"]
    assert counts.fragments == expected["num_fragmentations"]
    assert counts.mostly_tracked == expected["mostly_tracked"]
    assert counts.mostly_lost == expected["mostly_lost"]
    for key in ("mota", "motp", "recall", "precision"):
        assert getattr(counts, key) == pytest.approx(expected[key], abs=1e-9)


def check_hota(sequence: Sequence, expected: dict[str, list[float]]) -> None:
    """Fail unless HOTA and its parts are trackeval's at each threshold."""
    ours = hota(*as_rows(sequence))
    assert ours.true_positives.tolist() == expected["HOTA_TP"]
    assert ours.misses.tolist() == expected["HOTA_FN"]
    assert ours.false.tolist() == expected["HOTA_FP"]
    names = {
        "HOTA": "hota", "DetA": "det_a", "AssA": "ass_a", "DetRe": "det_re", "DetPr": "det_pr",
        "AssRe": "ass_re", "AssPr": "ass_pr", "LocA": "loc_a",
    }  # fmt: skip
    for theirs, name in names.items():
        np.testing.assert_allclose(getattr(ours, name), expected[theirs], atol=1e-9)
        assert math.isclose(ours.figures()[name], np.mean(expected[theirs]), abs_tol=1e-9)
