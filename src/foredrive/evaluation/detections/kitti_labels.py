"""3-D detections in KITTI's text format: a folder with a file for each frame, and one of truth.

A line: type, truncation, occlusion, alpha, image box (4), height, width, length (m), x, y, z of the bottom's
middle (m, camera: right, down, forward), rotation about y (rad), and for detections a score. Boxes are scored
in a frame of x forward, y left, z up. `DontCare` is left out. KITTI's text has no covariances.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

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
from foredrive.sets import Family, MultiBernoulli

LOWER = np.array([0.0, -60.0, -10.0, -3.0, -3.0, -3.0])
UPPER = np.array([120.0, 60.0, 10.0, 4.0, 4.0, 4.0])


class KittiLine(NamedTuple):
    """One line of a file, without its type's name in the numbers."""

    name: str
    """File and number of the line, for messages."""
    kind: str
    values: Float[ndarray, "_"]


KITTI_TYPES = (
    "car", "van", "truck", "pedestrian", "person", "person_sitting", "cyclist", "tram", "misc", "dontcare",
)  # fmt: skip
"""Types of objects in KITTI's labels of objects and tracks, in lower case."""


def check_type(kind: str, where: str) -> None:
    """Refuse a type that KITTI does not have.

    Raises:
        InputError: the message begins with `where` and names the types.
    """
    if kind.lower() not in KITTI_TYPES:
        raise InputError(f"{where} has the unknown class {kind!r}; there are: {', '.join(KITTI_TYPES)}")


def read_kitti(folder: Path, truth: Path, family: Family) -> DetectionSet:
    """Return the frames of the truth, by name.

    Raises:
        InputError: a file or a line is wrong. The message names the first.
    """
    true, found, classes, true_classes = read_frames(folder, truth)
    counts = {
        "frames_without_detections": sum(not (folder / name).exists() for name in true),
        "boxes_without_covariance": sum(len(lines) for lines in found.values()),
    }
    frames = []
    for name, lines in true.items():
        true_state, true_yaw = box_states(lines)
        labels = [classes.index(line.kind) for line in lines]
        frames.append(
            DetectionFrame(
                name.removesuffix(".txt"),
                name.removesuffix(".txt"),
                _detections(found[name], classes, family),
                make_objects([line.name for line in lines], labels, true_state, true_yaw),
                *enclosing_region(LOWER, UPPER, true_state),
                range_m=np.linalg.norm(true_state[:, :2], axis=1),
                visibility=np.array([line.values[1] for line in lines]),
            )
        )
    return DetectionSet(frames, classes, True, counts, true_classes)


def read_frames(
    folder: Path, truth: Path
) -> tuple[dict[str, list[KittiLine]], dict[str, list[KittiLine]], list[str], int]:
    """Return true and found lines by file, the classes (see `order_classes`), and how many the truth has.

    Raises:
        InputError: a file or a line is wrong. The message names the first.
    """
    true_paths, paths = sorted(truth.glob("*.txt")), {path.name for path in folder.glob("*.txt")}
    if not true_paths:
        raise InputError(f"{truth}: holds no text files")
    unknown = sorted(paths - {path.name for path in true_paths})
    if unknown:
        raise InputError(f"{folder / unknown[0]}: there is no such frame in {truth}")
    true = {path.name: _lines(path, 15) for path in true_paths}
    found = {name: _lines(folder / name, 16) if name in paths else [] for name in true}
    classes, true_classes = order_classes(
        *({line.kind for lines in each.values() for line in lines} for each in (true, found))
    )
    return true, found, classes, true_classes


def _detections(lines: Sequence[KittiLine], classes: Sequence[str], family: Family) -> MultiBernoulli:
    state, yaw = box_states(lines)
    return make_detections(
        [line.name for line in lines],
        np.array([line.values[14] for line in lines]),
        np.eye(len(classes))[[classes.index(line.kind) for line in lines]],
        state,
        np.tile(DEFAULT_COVARIANCE, (len(lines), 1, 1)),
        yaw,
        np.full(len(lines), STD_YAW_RAD),
        family=family,
    )


def _lines(path: Path, fields: int) -> list[KittiLine]:
    """Return the lines that are not `DontCare`."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not text that can be read") from error
    lines = []
    for n, line in enumerate(text.splitlines(), 1):
        words, name = line.split(), f"{path}: line {n}"
        if not words or words[0] == "DontCare":
            continue
        try:
            values = np.array([float(word) for word in words[1:]])
        except ValueError as error:
            raise InputError(f"{name} has something that is not a number") from error
        if len(values) < fields - 1:
            raise InputError(f"{name} has {len(words)} fields, not {fields}")
        if not (np.abs(values) <= MAX_NUMBER).all():
            raise InputError(f"{name} has a number that is not finite, or beyond {MAX_NUMBER:g}")
        if not (values[7:10] > 0).all():
            raise InputError(f"{name} has a box without size")
        lines.append(KittiLine(name, words[0], values))
    return lines


def box_states(lines: Sequence[KittiLine]) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n"]]:
    """Return centre and log length, width, height; and heading."""
    values = np.array([line.values[:14] for line in lines]).reshape(-1, 14)
    height, width, length, x, y, z, rotation = values[:, 7:14].T
    size = np.stack([length, width, height], axis=1)
    centre = np.stack([z, -x, -(y - height / 2)], axis=1)
    # The heading is (cos, 0, -sin) of the rotation in x, y, z of the camera.
    yaw = np.arctan2(-np.cos(rotation), -np.sin(rotation))
    return np.concatenate([centre, np.log(size)], axis=1), yaw
