"""Speed of detection and tracking: beside the devkit where it is installed, and on a whole validation set.

Beside the devkit, times are CPU times of all threads, so that other programs matter less. Ours have the
filter and the filling of gaps in them; the devkit's have only its evaluation of boxes that are ready.
"""

import dataclasses
import importlib.util
import json
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.common import forecast_scoring, nuscenes_devkit
from benchmarks.common.object_drives import (
    Drives,
    Size,
    detection_boxes,
    make_drives,
    tracking_boxes,
    truth_file,
)
from foredrive.tasks.detection.protocols import DETECTION_PROTOCOLS, evaluate_detections
from foredrive.tasks.motion.protocols import PROTOCOLS as MOTION_PROTOCOLS
from foredrive.tasks.motion.scores import score_motion
from foredrive.tasks.objects.nuscenes_json import ObjectTask
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES, Frames, ObjectRows, make_rows
from foredrive.tasks.objects.reading import read_objects
from foredrive.tasks.objects.truth import ObjectTruth
from foredrive.tasks.tracking.protocols import TRACKING_PROTOCOLS, evaluate_tracking

FIFTEEN_SCENES = Size(scenes=15, frames=40, objects=60, false=420, false_frames=3, reach_m=45.0, shares=True)
"""600 frames of some 250 detections."""
FIFTEEN_SCENES_TRACKED = dataclasses.replace(FIFTEEN_SCENES, false=120)
"""600 frames of some 100 boxes of tracks."""
COMPARED = Size(scenes=8, frames=30, objects=40, false=12, false_frames=3)
"""Drives on which protocols are compared."""
FRAMES, SCENE_FRAMES, FOUND, TRUE = 6019, 40, 300, 40
"""Frames of nuScenes' validation set, frames of a scene, and boxes of a frame."""
DETECTION, TRACKING = DETECTION_PROTOCOLS["nuscenes"], TRACKING_PROTOCOLS["nuscenes"]


def tracking_speed(seed: int) -> dict[str, float]:
    """Measure nuScenes' tracking evaluation of 15 scenes; the figures must be the devkit's."""
    drives = make_drives(seed, FIFTEEN_SCENES_TRACKED, ties=False)
    found, truth = _read(drives, "tracking")

    def ours() -> float:
        figures = evaluate_tracking(found, truth.boxes, truth.racks, truth.frames, TRACKING)
        return figures.all_classes["amota"]

    def devkit() -> Callable[[], float]:
        run = nuscenes_devkit.prepare_tracking(drives)
        return lambda: float(run.evaluate()[0].compute_metric("amota"))

    return {**_compared("tracking", ours, devkit, "motmetrics"), "found": float(len(found))}


def detection_speed(seed: int) -> dict[str, float]:
    """Measure nuScenes' detection evaluation of 15 scenes; the figures must be the devkit's."""
    drives = make_drives(seed, FIFTEEN_SCENES, ties=False)
    found, truth = _read(drives, "detection")

    def ours() -> float:
        return evaluate_detections(found, truth.boxes, truth.racks, DETECTION).nds

    def devkit() -> Callable[[], float]:
        run = nuscenes_devkit.prepare_detection(drives)
        return lambda: float(run.evaluate()[0].nd_score)

    return {**_compared("detection", ours, devkit, "nuscenes"), "found": float(len(found))}


def _read(drives: Drives, task: ObjectTask) -> tuple[ObjectRows, ObjectTruth]:
    with tempfile.TemporaryDirectory() as folder:
        results, truth = Path(folder) / "results.json", Path(folder) / "truth.json"
        if task == "detection":
            boxes = {token: detection_boxes(each) for token, each in drives.detections.items()}
        else:
            boxes = {token: tracking_boxes(each, TRACKING.classes) for token, each in drives.tracks.items()}
        results.write_text(json.dumps({"results": boxes}))
        truth.write_text(json.dumps(truth_file(drives)))
        found, true = read_objects(results, truth, task)
    return found.boxes, true


def _compared(
    task: str, ours: Callable[[], float], devkit: Callable[[], Callable[[], float]], package: str
) -> dict[str, float]:
    ours()  # compile
    value, ours_s = min((_timed(ours) for _ in range(3)), key=lambda each: each[1])
    figures = {f"{task}_15_scenes_cpu_s": ours_s}
    if importlib.util.find_spec(package) is None:
        return figures
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the devkit's own
        expected, devkit_s = _timed(devkit())
    np.testing.assert_allclose(value, expected, atol=1e-6)
    return {**figures, f"{task}_15_scenes_devkit_cpu_s": devkit_s, f"{task}_speedup": devkit_s / ours_s}


def _timed(run: Callable[[], float]) -> tuple[float, float]:
    started = time.process_time()
    value = run()
    return value, time.process_time() - started


def validation_size(seed: int) -> dict[str, float]:
    """Measure all tasks on as many frames as nuScenes' validation set has, from arrays.

    `validation_size_s` is by the clock, which other programs slow down; `validation_cpu_s` is CPU time.
    """
    wall_s, cpu_s = {}, 0.0
    for name, prepare in VALIDATION_TASKS.items():
        run = prepare(np.random.default_rng(seed))
        started, started_cpu = time.perf_counter(), time.process_time()
        run()
        wall_s[f"validation_{name}_s"] = time.perf_counter() - started
        cpu_s += time.process_time() - started_cpu
    return {**wall_s, "validation_size_s": sum(wall_s.values()), "validation_cpu_s": cpu_s}


def _validation_detection(rng: np.random.Generator) -> Callable[[], object]:
    found, true, _ = _validation_rows(rng)
    return lambda: evaluate_detections(found, true, true[:0], DETECTION)


def _validation_tracking(rng: np.random.Generator) -> Callable[[], object]:
    found, true, frames = _validation_rows(rng, TRACKING.classes)
    return lambda: evaluate_tracking(found, true, true[:0], frames, TRACKING)


def _validation_motion(rng: np.random.Generator) -> Callable[[], object]:
    predicted, true = forecast_scoring.scene(rng, FRAMES)
    return lambda: score_motion(predicted, true, MOTION_PROTOCOLS["uniad"])


VALIDATION_TASKS: dict[str, Callable[[np.random.Generator], Callable[[], object]]] = {
    "detection": _validation_detection,
    "tracking": _validation_tracking,
    "motion": _validation_motion,
}
"""Preparation and measured function of each task."""


def _validation_rows(
    rng: np.random.Generator, classes: tuple[str, ...] = DETECTION_CLASSES
) -> tuple[ObjectRows, ObjectRows, Frames]:
    """Objects that move straight on; 85 % are found in each frame, and false tracks last four frames."""
    frame = np.arange(FRAMES)
    scene, step = frame // SCENE_FRAMES, frame % SCENE_FRAMES
    scenes = int(scene[-1]) + 1
    start, speed = rng.uniform(-60, 60, (scenes, TRUE, 2)), rng.normal(0, 3, (scenes, TRUE, 2))
    true_xy = start[scene] + speed[scene] * 0.5 * step[:, None, None]
    true_label = rng.integers(0, len(classes), (scenes, TRUE))[scene]
    true_score = rng.beta(3, 2, (scenes, TRUE))[scene]
    true_track = np.broadcast_to(np.arange(TRUE), (FRAMES, TRUE))
    false, part = FOUND - TRUE, scene * SCENE_FRAMES + step // 4
    parts = int(part[-1]) + 1
    false_xy = rng.uniform(-60, 60, (parts, false, 2))[part] + rng.normal(0, 0.3, (FRAMES, false, 2))
    false_label = rng.integers(0, len(classes), (parts, false))[part]
    false_score = rng.beta(1, 3, (parts, false))[part]
    false_track = TRUE + (step // 4)[:, None] * false + np.arange(false)
    xy, label, score, track = (
        np.concatenate([a, b], axis=1)
        for a, b in (
            (true_xy + rng.normal(0, 0.5, true_xy.shape), false_xy),
            (true_label, false_label),
            (true_score, false_score),
            (true_track, false_track),
        )
    )
    seen = np.concatenate([rng.random((FRAMES, TRUE)) < 0.85, np.ones((FRAMES, false), bool)], axis=1)
    found = _as_rows(xy, label, track, seen, score)
    true = _as_rows(true_xy, true_label, true_track, np.ones((FRAMES, TRUE), bool))
    return found, true, Frames(scene, 500_000 * frame)


def _as_rows(
    xy: np.ndarray, label: np.ndarray, track: np.ndarray, kept: np.ndarray, score: np.ndarray | None = None
) -> ObjectRows:
    """Rows of tables by frame and slot."""
    n, place = int(kept.sum()), xy[kept]
    return make_rows(
        np.nonzero(kept)[0],
        label[kept],
        np.pad(place, ((0, 0), (0, 1))),
        np.full((n, 3), 2.0),
        np.zeros(n),
        velocity=np.zeros((n, 2)),
        attribute=np.zeros(n, np.int64),
        score=np.full(n, np.nan) if score is None else score[kept],
        from_ego=place,
        track=track[kept],
    )


def protocols_compared(seed: int) -> dict[str, float]:
    """Return what the same synthetic detections and tracks score under each protocol."""
    drives = make_drives(seed, COMPARED, ties=False)
    figures: dict[str, float] = {}
    found, truth = _read(drives, "detection")
    for name, protocol in DETECTION_PROTOCOLS.items():
        scored = evaluate_detections(found, truth.boxes, truth.racks, protocol)
        for key, value in {"map": scored.mean_ap, "nds": scored.nds, **scored.errors}.items():
            figures[f"detection.{name}.{key}"] = value
    found, truth = _read(drives, "tracking")
    for name, rules in TRACKING_PROTOCOLS.items():
        averages = evaluate_tracking(found, truth.boxes, truth.racks, truth.frames, rules).all_classes
        for key in ("amota", "amotp", "recall", "mota", "motp", "ids", "frag"):
            figures[f"tracking.{name}.{key}"] = averages[key]
    return figures
