"""Detections in KITTI's text format as rows, for average precision and errors by distance.

KITTI's own average precision is by overlap; this is nuScenes' matching, without ranges, on KITTI's classes.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from foredrive.engine.summary import Figures
from foredrive.tasks.detection.kitti_labels import KittiLine, box_states, check_type, read_frames
from foredrive.tasks.detection.protocols import DETECTION_PROTOCOLS, evaluate_detections
from foredrive.tasks.files.plain_files import tell_left_out
from foredrive.tasks.objects.object_rows import ObjectRows, Region, make_rows

_UNKNOWN = frozenset({"ave_mps", "aae"})
"""Errors that need values which KITTI's text does not have."""


def score_kitti_boxes(folder: Path, truth: Path) -> Figures:
    """Return average precision at each distance and the errors that KITTI's text allows, by class.

    Raises:
        InputError: a file or a line is wrong. The message names the first.
    """
    true, predicted, classes, true_classes = read_frames(folder, truth)
    for lines in true.values():
        for line in lines:
            check_type(line.kind, line.name)
    # Detections of classes that the truth lacks cannot be judged
    others = _drop_other_classes(predicted, classes[:true_classes])
    tell_left_out(folder, {"boxes of other classes": others}, others + sum(map(len, predicted.values())))
    protocol = dataclasses.replace(
        DETECTION_PROTOCOLS["nuscenes"],
        title="KITTI, by distance",
        classes=tuple(classes[:true_classes]),
        # No ranges: KITTI has none
        region=Region("circle", {}),
        without=dict.fromkeys(classes, _UNKNOWN),
    )
    found_rows = _rows(list(predicted.values()), protocol.classes, scored=True)
    true_rows = _rows(list(true.values()), protocol.classes, scored=False)
    scored = evaluate_detections(found_rows, true_rows, true_rows[:0], protocol)
    figures: Figures = {
        "data_set": "kitti",
        "frames_counted": len(true),
        "objects": len(true_rows),
        "found": len(found_rows),
        "boxes_of_other_classes_left_out": others,
        "detection.kitti.map": scored.mean_ap,
        **{f"detection.kitti.{key}": scored.errors[key] for key in scored.errors if key not in _UNKNOWN},
    }
    for name, of_class in scored.by_class.items():
        label = name.lower()
        figures[f"detection.kitti.{label}.ap"] = float(np.mean([*of_class.ap.values()]))
        figures |= {f"detection.kitti.{label}.ap_{radius_m:g}m": ap for radius_m, ap in of_class.ap.items()}
        errors = {key: error for key, error in of_class.errors.items() if key not in _UNKNOWN}
        figures |= {f"detection.kitti.{label}.{key}": error for key, error in errors.items()}
    return figures


def _drop_other_classes(predicted: dict[str, list[KittiLine]], classes: Sequence[str]) -> int:
    """Remove the lines of other classes, and return their number."""
    given = sum(map(len, predicted.values()))
    for name, lines in predicted.items():
        predicted[name] = [line for line in lines if line.kind in classes]
    return given - sum(map(len, predicted.values()))


def _rows(frames: list[list[KittiLine]], classes: tuple[str, ...], *, scored: bool) -> ObjectRows:
    lines = [line for frame_lines in frames for line in frame_lines]
    state, yaw = box_states(lines)
    frame = np.repeat(np.arange(len(frames)), [len(frame_lines) for frame_lines in frames])
    label_of = {name: n for n, name in enumerate(classes)}
    score = np.array([line.values[14] if scored else np.nan for line in lines]).reshape(-1)
    return make_rows(
        frame,
        np.array([label_of.get(line.kind, -1) for line in lines], dtype=np.int64),
        state[:, :3],
        np.exp(state[:, 3:]),
        yaw,
        score=score.astype(np.float64),
    )
