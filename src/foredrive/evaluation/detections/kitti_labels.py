"""3-D detections in KITTI's text format: a folder with a file for each frame, and one of truth.

A line: type, truncation, occlusion, alpha, image box (4), height, width, length (m), x, y, z of the bottom's
middle (m, camera: right, down, forward), rotation about y (rad), and for detections a score. Boxes are scored
in a frame of x forward, y left, z up. `DontCare` is left out. KITTI's text has no covariances.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.evaluation.detections.frames import (
    MAX_NUMBER,
    STD_YAW_RAD,
    DetectionFrame,
    DetectionSet,
    enclosing_region,
    make_detections,
    make_objects,
    order_classes,
)
from foredrive.evaluation.detections.nuscenes_results import DEFAULT_COVARIANCE
from foredrive.sets import Family

LOWER = np.array([0.0, -60.0, -10.0, -3.0, -3.0, -3.0])
UPPER = np.array([120.0, 60.0, 10.0, 4.0, 4.0, 4.0])
Line = tuple[str, Float[ndarray, "_"]]


def read_kitti(folder: Path, truth: Path, family: Family) -> DetectionSet:
    """Return the frames of the truth by name. Raises `InputError` that names the wrong line."""
    true_paths, paths = sorted(truth.glob("*.txt")), {path.name for path in folder.glob("*.txt")}
    if not true_paths:
        raise InputError(f"{truth}: holds no text files")
    unknown = sorted(paths - {path.name for path in true_paths})
    if unknown:
        raise InputError(f"{folder / unknown[0]}: there is no such frame in {truth}")
    true = {path.name: _lines(path, 15) for path in true_paths}
    found = {name: _lines(folder / name, 16) if name in paths else [] for name in true}
    classes, true_classes = order_classes(
        *({kind for lines in each.values() for kind, _ in lines} for each in (true, found))
    )
    counts = {
        "frames_without_detections": len(set(true) - paths),
        "boxes_without_covariance": sum(len(lines) for lines in found.values()),
    }
    frames = []
    for name, lines in true.items():
        predicted = found[name]
        state, yaw = _states(predicted, folder / name)
        true_state, true_yaw = _states(lines, truth / name)
        share = np.eye(len(classes))[[classes.index(kind) for kind, _ in predicted]]
        covariance = np.tile(DEFAULT_COVARIANCE, (len(predicted), 1, 1))
        score = np.array([values[14] for _, values in predicted])
        detected = make_detections(
            str(folder / name), score, share, state, covariance, yaw, np.full(len(predicted), STD_YAW_RAD),
            family=family,
        )  # fmt: skip
        labels = [classes.index(kind) for kind, _ in lines]
        frames.append(
            DetectionFrame(
                name.removesuffix(".txt"),
                name.removesuffix(".txt"),
                detected,
                make_objects(str(truth / name), labels, true_state, true_yaw),
                *enclosing_region(LOWER, UPPER, true_state),
                range_m=np.linalg.norm(true_state[:, :2], axis=1),
                visibility=np.array([values[1] for _, values in lines]),
            )
        )
    return DetectionSet(frames, classes, True, counts, true_classes)


def _lines(path: Path, fields: int) -> list[Line]:
    """Return type and numbers of each line that is not `DontCare`."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not text that can be read") from error
    lines = []
    for n, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0] == "DontCare":
            continue
        try:
            values = np.array([float(word) for word in words[1:]])
        except ValueError as error:
            raise InputError(f"{path}: line {n} has something that is not a number") from error
        if len(values) < fields - 1:
            raise InputError(f"{path}: line {n} has {len(words)} fields, not {fields}")
        if not (np.abs(values) <= MAX_NUMBER).all():
            raise InputError(f"{path}: line {n} has a number that is not finite, or beyond {MAX_NUMBER:g}")
        lines.append((words[0], values))
    return lines


def _states(lines: list[Line], path: Path) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n"]]:
    values = np.array([values[:14] for _, values in lines]).reshape(-1, 14)
    height, width, length, x, y, z, rotation = values[:, 7:14].T
    size = np.stack([length, width, height], axis=1)
    if not (size > 0).all():
        raise InputError(f"{path}: box {np.flatnonzero(~(size > 0).all(1))[0]} has no size")
    centre = np.stack([z, -x, -(y - height / 2)], axis=1)
    # The heading is (cos, 0, -sin) of the rotation in x, y, z of the camera.
    yaw = np.arctan2(-np.cos(rotation), -np.sin(rotation))
    return np.concatenate([centre, np.log(size)], axis=1), yaw
