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
from foredrive.sets import Family, MultiBernoulli
from foredrive.tasks.detection.frames import (
    STD_YAW_RAD,
    DetectionFrame,
    DetectionSet,
    enclosing_region,
    make_detections,
    make_objects,
    order_classes,
)
from foredrive.tasks.detection.nuscenes_results import DEFAULT_COVARIANCE
from foredrive.tasks.files.plain_files import MAX_NUMBER, tell_left_out

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


def result_files(folder: Path, truth: Path, what: str) -> tuple[Path, set[str]]:
    """Return the folder of results and the names of its text files, all of which are in the truth.

    Where no file of the folder is in the truth, the results are those of its folder `data`, as TrackEval and
    AB3DMOT write them.

    Args:
        folder, truth: folders with a text file for each frame or sequence.
        what: a frame or a sequence, for messages.

    Raises:
        InputError: there are no text files in the truth, none of it in the results, or one that is not in it.
    """
    true = {path.name for path in truth.glob("*.txt")}
    if not true:
        raise InputError(f"{truth}: holds no text files")
    for place in (folder, folder / "data"):
        files = {path.name for path in place.glob("*.txt")}
        if not files & true:
            continue
        if files - true:
            raise InputError(f"{place / min(files - true)}: there is no such {what} in {truth}")
        return place, files
    raise InputError(
        f"{folder}: holds no results of the {what}s in {truth}, such as {min(true)}, nor in data/"
    )


def read_kitti(folder: Path, truth: Path, family: Family) -> DetectionSet:
    """Return the frames of the truth, by name.

    Raises:
        InputError: a file or a line is wrong. The message names the first.
    """
    true, predicted, classes, true_classes = read_frames(folder, truth)
    counts = {
        "frames_without_detections": len(set(true) - result_files(folder, truth, "frame")[1]),
        "boxes_without_covariance": sum(len(lines) for lines in predicted.values()),
    }
    frames = []
    for name, lines in true.items():
        true_state, true_yaw = box_states(lines)
        labels = [classes.index(line.kind) for line in lines]
        frames.append(
            DetectionFrame(
                name.removesuffix(".txt"),
                name.removesuffix(".txt"),
                _detections(predicted[name], classes, family),
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
    folder, files = result_files(folder, truth, "frame")
    true = {path.name: _lines(path, 15) for path in sorted(truth.glob("*.txt"))}
    predicted = {name: _lines(folder / name, 16) if name in files else [] for name in true}
    for lines_of, where in ((true, truth), (predicted, folder)):
        given = sum(len(lines) for lines in lines_of.values())
        for name, lines in lines_of.items():
            # Log sizes need positive lengths, so boxes without size are left out
            lines_of[name] = [line for line in lines if (line.values[7:10] > 0).all()]
        sized = sum(len(lines) for lines in lines_of.values())
        tell_left_out(where, {"boxes without size": given - sized}, given)
    classes, true_classes = order_classes(
        *({line.kind for lines in side.values() for line in lines} for side in (true, predicted))
    )
    return true, predicted, classes, true_classes


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
        text = path.read_text("utf-8-sig")
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
        lines.append(KittiLine(name, words[0], values))
    return lines


def box_states(lines: Sequence[KittiLine]) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n"]]:
    """Return centre and log length, width, height; and heading."""
    values = np.array([line.values[:14] for line in lines]).reshape(-1, 14)
    height, width, length, x, y, z, rotation = values[:, 7:14].T
    size = np.stack([length, width, height], axis=1)
    # Camera axes (right, down, forward) to forward, left, up; from the bottom's middle to the centre
    centre = np.stack([z, -x, -(y - height / 2)], axis=1)
    # The heading is (cos, 0, -sin) of the rotation in x, y, z of the camera.
    yaw = np.arctan2(-np.cos(rotation), -np.sin(rotation))
    return np.concatenate([centre, np.log(size)], axis=1), yaw
