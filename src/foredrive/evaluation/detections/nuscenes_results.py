"""3-D detections in nuScenes' results format, and truth in the same.

`results` has a list of boxes by sample token: `translation` (m, global), `size` (w, l, h in m), `rotation`
(quaternion w x y z), `detection_name`, `detection_score`. Beyond the format, a box may have `covariance` (of
centre and log l, w, h in m), `yaw_std` (rad) and `class_probabilities` (by name). Truth may have `num_pts`
and `ego_translation`, as the devkit writes them, `scene_token` and `relevance`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.evaluation.detections.frames import (
    STD_LOG_SIZE,
    STD_M,
    STD_YAW_RAD,
    DetectionFrame,
    DetectionSet,
    enclosing_region,
    make_detections,
    make_objects,
    order_classes,
    read_class_probabilities,
    read_covariances,
    read_number_rows,
    read_numbers,
    read_relevance,
)
from foredrive.sets import Family

LOWER = np.array([-60.0, -60.0, -10.0, -3.0, -3.0, -3.0])
UPPER = np.array([60.0, 60.0, 10.0, 4.0, 4.0, 4.0])
"""Region of objects: around the ego vehicle, or the middle of the frame's boxes, in m and log m."""
DEFAULT_COVARIANCE = np.diag(np.square([*STD_M, *[STD_LOG_SIZE] * 3]))

Box = Mapping[str, Any]


def read_nuscenes(
    results: Mapping[str, Any], truth: Mapping[str, Any], path: Path, truth_path: Path, family: Family
) -> DetectionSet:
    """Return the frames of the truth, in its order. Raises `InputError` that names the wrong record."""
    found, true = _by_frame(results, path), _by_frame(truth, truth_path)
    unknown = sorted(set(found) - set(true))
    if unknown:
        raise InputError(f"{path}: frame {unknown[0]} ({len(unknown)} in all) is not in {truth_path}")
    classes, true_classes = order_classes(
        *({box["detection_name"] for boxes in each.values() for box in boxes} for each in (true, found))
    )
    counts = {"frames_without_detections": len(set(true) - set(found)), "boxes_without_covariance": 0}
    frames = []
    for token, boxes in true.items():
        predicted = found.get(token, ())
        counts["boxes_without_covariance"] += sum(box.get("covariance") is None for box in predicted)
        frames.append(_frame(token, predicted, boxes, classes, path, truth_path, family))
    return DetectionSet(frames, classes, True, counts, true_classes)


def _frame(
    token: str,
    predicted: Sequence[Box],
    true: Sequence[Box],
    classes: Sequence[str],
    path: Path,
    truth_path: Path,
    family: Family,
) -> DetectionFrame:
    where, true_where = f"{path}: frame {token}", f"{truth_path}: frame {token}"
    state, yaw = _states(predicted, where)
    true_state, true_yaw = _states(true, true_where)
    ego = _ego(true, true_state, true_where)
    every = np.concatenate([true_state, state])[:, :3]
    origin = ego if ego is not None else every.mean(0) if len(every) else np.zeros(3)
    state[:, :3] -= origin
    true_state[:, :3] -= origin
    label = [classes.index(box["detection_name"]) for box in predicted]
    names = [f"{where}, box {n}" for n in range(len(predicted))]
    yaw_std = [{"yaw_std": box.get("yaw_std", STD_YAW_RAD)} for box in predicted]
    detected = make_detections(
        where,
        read_number_rows(predicted, "detection_score", 1, names)[:, 0],
        read_class_probabilities(predicted, label, classes, names),
        state,
        read_covariances(predicted, np.tile(DEFAULT_COVARIANCE, (len(predicted), 1, 1)), names),
        yaw,
        read_number_rows(yaw_std, "yaw_std", 1, names)[:, 0],
        family=family,
    )
    objects = make_objects(
        true_where, [classes.index(box["detection_name"]) for box in true], true_state, true_yaw
    )
    true_names = [f"{true_where}, box {n}" for n in range(len(true))]
    seen = [
        read_numbers(box, "num_pts", 1, name)[0] if "num_pts" in box else np.nan
        for box, name in zip(true, true_names, strict=True)
    ]
    return DetectionFrame(
        token,
        str(true[0].get("scene_token", token)) if true else token,
        detected,
        objects,
        *enclosing_region(LOWER, UPPER, true_state),
        range_m=None if ego is None else np.linalg.norm(true_state[:, :2], axis=1),
        visibility=np.array(seen),
        relevance=read_relevance(true, true_where),
    )


def _by_frame(content: Mapping[str, Any], path: Path) -> dict[str, Sequence[Box]]:
    boxes = content.get("results")
    if not isinstance(boxes, dict) or not all(isinstance(each, list) for each in boxes.values()):
        raise InputError(f"{path}: `results` must have a list of boxes by sample token")
    for token, each in boxes.items():
        for n, box in enumerate(each):
            if not isinstance(box, dict) or not isinstance(box.get("detection_name"), str):
                raise InputError(f"{path}: frame {token}, box {n} has no detection_name")
    return boxes


def _states(boxes: Sequence[Box], where: str) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n"]]:
    """Return centre and log length, width, height; and heading."""
    names = [f"{where}, box {n}" for n in range(len(boxes))]
    centre, size, rotation = (
        read_number_rows(boxes, key, count, names)
        for key, count in (("translation", 3), ("size", 3), ("rotation", 4))
    )
    wrong = np.flatnonzero(~(size > 0).all(1))
    if len(wrong):
        raise InputError(f"{names[wrong[0]]} has the size {size[wrong[0]].tolist()}")
    wrong = np.flatnonzero(~(np.linalg.norm(rotation, axis=1) > 0))
    if len(wrong):
        raise InputError(f"{names[wrong[0]]} has the rotation {rotation[wrong[0]].tolist()}")
    w, x, y, z = (rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    return np.concatenate([centre, np.log(size[:, [1, 0, 2]])], axis=1), yaw


def _ego(true: Sequence[Box], true_state: Float[ndarray, "N 6"], where: str) -> Float[ndarray, "3"] | None:
    """Return the ego vehicle's place, if the truth has it: the devkit writes boxes relative to it."""
    if not true or "ego_translation" not in true[0]:
        return None
    return true_state[0, :3] - read_numbers(true[0], "ego_translation", 3, f"{where}, box 0")
