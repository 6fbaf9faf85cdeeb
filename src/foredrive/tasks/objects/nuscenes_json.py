"""Detection and tracking results of nuScenes, and ground truth in the same format.

A file has lists of boxes by sample token, under `results` or alone (as the devkit's `EvalBoxes.serialize`
returns them). A box has `translation` (m, global), `size` (w, l, h in m), `rotation` (quaternion w x y z),
`velocity` (m/s, NaN where unknown), and either `detection_name`, `detection_score` and `attribute_name`, or
`tracking_name`, `tracking_score` and `tracking_id`.

Boxes of both files may have `num_pts` and `ego_translation`. Truth may have either name, and `tracking_id`.
Boxes with the name of a bicycle rack are no objects. Boxes without length, width or height are left out.
Tracking needs the scene and the time of each sample: `scene_token` and `timestamp` (µs), in its boxes or
under `samples`, an object by sample token. There `ego_translation` is the place of the ego vehicle; in a box
it is the box's offset from it.
"""

import dataclasses
import itertools
import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.scene.boxes import UNKNOWN, Attribute
from foredrive.tasks.files.frames_of_results import check_known_frames
from foredrive.tasks.files.plain_files import read_number_rows, read_numbers, read_plain, tell_left_out
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES, Frames, ObjectRows, make_rows
from foredrive.tasks.objects.truth import (
    RACK,
    BoxNames,
    FoundObjects,
    ObjectTruth,
    check_tracks,
    lacking,
    number_names,
)

Box = Mapping[str, Any]
_log = logging.getLogger(__name__)


def boxes_by_frame(path: Path, content: Mapping[str, Any]) -> dict[str, Sequence[Box]]:
    """Return the boxes of a file by sample token.

    Raises:
        InputError: it has none.
    """
    boxes = content.get("results", content)
    if not isinstance(boxes, dict) or not all(
        isinstance(frame_boxes, list) for frame_boxes in boxes.values()
    ):
        raise InputError(f"{path}: there must be a list of boxes by sample token, under `results` or alone")
    for name, frame_boxes in boxes.items():
        for n, box in enumerate(frame_boxes):
            if not isinstance(box, dict):
                raise InputError(f"{path}: frame {name}, box {n} is no object")
    return boxes


def read_geometry(
    boxes: Sequence[Box], names: Sequence[str]
) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3"], Float[ndarray, "n"]]:
    """Return centre (m, global), length, width, height (m, 0 where a box has none), and heading (rad).

    Raises:
        InputError: a box has a size below 0 or no rotation, or a number that is not finite.
    """
    centre, size, rotation = (
        read_number_rows(boxes, key, count, names)
        for key, count in (("translation", 3), ("size", 3), ("rotation", 4))
    )
    wrong = np.flatnonzero((size < 0).any(1))
    if len(wrong):
        raise InputError(f"{names[wrong[0]]} has the size {size[wrong[0]].tolist()}")
    wrong = np.flatnonzero(~(np.linalg.norm(rotation, axis=1) > 0))
    if len(wrong):
        raise InputError(f"{names[wrong[0]]} has the rotation {rotation[wrong[0]].tolist()}")
    # Yaw of a unit quaternion w x y z
    w, x, y, z = (rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    # nuScenes writes width, length, height
    return centre, size[:, [1, 0, 2]], yaw


def read_labels(
    boxes: Sequence[Box],
    keys: Sequence[str],
    classes: Sequence[str],
    others: Collection[str],
    names: Sequence[str],
) -> Int[ndarray, "n"]:
    """Return the index of each box's class, from the first of `keys` that it has; -1 for one of `others`."""
    # Known classes that are not judged have the label -1
    number = {**dict.fromkeys(others, -1), **{name: n for n, name in enumerate(classes)}}
    label = np.zeros(len(boxes), np.int64)
    for n, box in enumerate(boxes):
        name = next((box[key] for key in keys if key in box), None)
        if not isinstance(name, str):
            raise InputError(f"{names[n]} has no {keys[0]}")
        if name not in number:
            raise InputError(f"{names[n]} has the unknown class {name!r}; there are: {', '.join(classes)}")
        label[n] = number[name]
    return label


def read_texts(boxes: Sequence[Box], key: str, names: Sequence[str]) -> list[str]:
    """Return the texts, or whole numbers as texts, that boxes have under `key`."""
    texts = [box.get(key) for box in boxes]
    for n, text in enumerate(texts):
        if not isinstance(text, str | int) or text == "":
            raise InputError(f"{names[n]} has no {key}")
    return [str(text) for text in texts]


def read_scores(
    boxes: Sequence[Box], key: str, names: Sequence[str], *, only_ranks: bool
) -> Float[ndarray, "n"]:
    """Return scores, all in [0, 1] unless they only rank."""
    score = read_number_rows(boxes, key, 1, names)[:, 0]
    wrong = np.flatnonzero(~((score >= 0) & (score <= 1)) & (not only_ranks))
    if len(wrong):
        raise InputError(f"{names[int(wrong[0])]} has the {key} {score[wrong[0]]:g}, which is not in [0, 1]")
    return score


def read_velocities(boxes: Sequence[Box], names: Sequence[str]) -> Float[ndarray, "n 2"]:
    """Return velocities over ground, m/s. NaN, null, or no `velocity` at all: unknown."""
    # Boxes that state a velocity; the others are unknown
    stated = [n for n, box in enumerate(boxes) if _states_velocity(box.get("velocity"))]
    velocity = np.full((len(boxes), 2), np.nan)
    velocity[stated] = read_number_rows([boxes[n] for n in stated], "velocity", 2, _Chosen(names, stated))
    return velocity


def _states_velocity(value: object) -> bool:
    """Return whether a velocity is stated: neither missing nor NaN, which is what the devkit writes."""
    if value is None:
        return False
    return not (isinstance(value, list | tuple) and any(x is None or x != x for x in value))


def read_attributes(boxes: Sequence[Box], names: Sequence[str]) -> Int[ndarray, "n"]:
    """Return indices of attributes; `UNKNOWN` for the empty name, or none."""
    number = {"": int(UNKNOWN), **{attribute.label: int(attribute) for attribute in Attribute}}
    stated = [box.get("attribute_name", "") for box in boxes]
    for n, name in enumerate(stated):
        if name not in number:
            raise InputError(f"{names[n]} has the unknown attribute_name {name!r}")
    return np.array([number[name] for name in stated], dtype=np.int64)


def read_points(boxes: Sequence[Box], names: Sequence[str]) -> Int[ndarray, "n"]:
    """Return the numbers of points that boxes state."""
    stated = [{"num_pts": box.get("num_pts", UNKNOWN)} for box in boxes]
    return read_number_rows(stated, "num_pts", 1, names)[:, 0].astype(np.int64)


class _Chosen(Sequence[str]):
    """Some of the names of boxes, by their numbers."""

    def __init__(self, names: Sequence[str], numbers: Sequence[int]) -> None:
        self._names, self._numbers = names, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: Any) -> Any:
        return self._names[int(self._numbers[index])]


ObjectTask = Literal["detection", "tracking"]
_TRUE_NAMES = ("tracking_name", "detection_name")


@dataclass(frozen=True)
class Sample:
    """Scene, time and ego vehicle of a frame, as far as the ground truth states them."""

    scene: str | None
    time_us: int | None
    ego: Float[ndarray, "2"] | None
    """Place of the ego vehicle over ground, m, global."""


def read_results(
    path: Path, truth: ObjectTruth, truth_path: Path, task: ObjectTask, classes: Sequence[str], max_boxes: int
) -> FoundObjects:
    """Read the detections or tracks of a results file.

    Args:
        truth, truth_path: the frames that the results are of.
        classes: of the task; labels are their indices.
        max_boxes: largest number of boxes that a frame may have.

    Raises:
        InputError: a box is wrong, or a frame has no ground truth. The message names the first.
    """
    by_frame = boxes_by_frame(path, read_object(path))
    check_known_frames(path, by_frame, truth_path, truth.names)
    for name, frame_boxes in by_frame.items():
        if len(frame_boxes) > max_boxes:
            raise InputError(
                f"{path}: frame {name} has {len(frame_boxes)} boxes, and {max_boxes} are allowed"
            )
    names, boxes = BoxNames(path, by_frame), [box for frame_boxes in by_frame.values() for box in frame_boxes]
    # Frame of each box as an index into the truth's frames
    number = {name: n for n, name in enumerate(truth.names)}
    frame = np.array(
        [number[name] for name, frame_boxes in by_frame.items() for _ in frame_boxes], dtype=np.int64
    )
    label = read_labels(boxes, (f"{task}_name",), classes, (), names)
    centre, size_lwh, yaw = read_geometry(boxes, names)
    columns: dict[str, ndarray] = {
        "score": read_scores(boxes, f"{task}_score", names, only_ranks=task == "detection"),
        "velocity": read_velocities(boxes, names),
        "num_points": read_points(boxes, names),
        # Range from the ego vehicle decides about what counts
        "from_ego": centre[:, :2] - truth.ego[frame],
    }
    missing = len(number) - len(by_frame)
    if task == "detection":
        columns["attribute"] = read_attributes(boxes, names)
        rows = make_rows(frame, label, centre, size_lwh, yaw, **columns)
        return FoundObjects(_with_size([rows], path)[0], missing)
    # Identities are numbered in order of appearance
    identities = read_texts(boxes, "tracking_id", names)
    columns["track"] = number_names(identities)
    rows = make_rows(frame, label, centre, size_lwh, yaw, **columns)
    check_tracks(rows, identities, names)
    return FoundObjects(_with_size([rows], path)[0], missing)


def with_places_of_results(truth: ObjectTruth, path: Path) -> ObjectTruth:
    """Return the truth with the ego vehicle's place from a results file in the frames that lack it.

    One line says in how many frames with boxes the place stays unknown: nothing is too far away there.

    Raises:
        InputError: an offset of the results is wrong.
    """
    by_frame = boxes_by_frame(path, read_object(path))
    ego, unfiltered = truth.ego.copy(), 0
    not_empty = set(truth.boxes.frame.tolist())
    for n in np.flatnonzero(np.isnan(ego[:, 0])).tolist():
        stated = by_frame.get(truth.names[n], ())
        place = _place(stated, f"{path}: frame {truth.names[n]}")
        if place is not None:
            ego[n] = place
        elif stated or n in not_empty:
            unfiltered += 1
    if unfiltered:
        _log.warning(
            "boxes of %d of %d frames are not filtered by range: "
            "no file states the ego vehicle's place there",
            unfiltered,
            len(ego),
        )
    boxes, racks = (
        dataclasses.replace(rows, from_ego=rows.centre[:, :2] - ego[rows.frame])
        for rows in (truth.boxes, truth.racks)
    )
    return dataclasses.replace(truth, boxes=boxes, racks=racks, ego=ego, lacks=lacking(boxes))


def read_json_truth(path: Path, task: ObjectTask, classes: Sequence[str]) -> ObjectTruth:
    """Read ground truth in the format of results.

    Raises:
        InputError: a box is wrong, or tracking lacks a scene, a time or an identity.
    """
    whole = read_object(path)
    content, stated = boxes_by_frame(path, whole), whole.get("samples", {})
    if not isinstance(stated, dict) or not all(isinstance(sample, dict) for sample in stated.values()):
        raise InputError(f"{path}: its `samples` must be objects by sample token")
    samples = {
        name: _sample(stated.get(name, {}), boxes, f"{path}: frame {name}") for name, boxes in content.items()
    }
    return make_truth(content, samples, path, task, classes)


def make_truth(
    content: Mapping[str, Sequence[Box]],
    samples: Mapping[str, Sample],
    path: Path,
    task: ObjectTask,
    classes: Sequence[str],
) -> ObjectTruth:
    """Return the ground truth of boxes by frame; for tracking, frames are ordered by scene and time.

    Classes that the task leaves out have the label -1.

    Raises:
        InputError: a box is wrong, or tracking lacks a scene, a time or an identity.
    """
    # Tracking needs frames by scene and time
    if task == "tracking":
        content = {name: content[name] for name in _in_time(samples, path)}
    # Bicycle racks are kept apart: they only exclude boxes in them
    racks, objects = (
        {name: [box for box in boxes if (_name(box) == RACK) is rack] for name, boxes in content.items()}
        for rack in (True, False)
    )
    ego = np.array(
        [(np.nan, np.nan) if (position := samples[name].ego) is None else position for name in content]
    )
    ego = ego.reshape(-1, 2).astype(np.float64)
    boxes, rack_boxes = _with_size(
        [_true_rows(objects, ego, path, task, classes), _true_rows(racks, ego, path, "detection", ())], path
    )
    times = np.array([samples[name].time_us or 0 for name in content], dtype=np.int64)
    frames = Frames(number_names(samples[name].scene or name for name in content), times)
    return ObjectTruth(list(content), boxes, rack_boxes, frames, ego, lacking(boxes))


def read_object(path: Path) -> Mapping[str, Any]:
    """Read a JSON object.

    Raises:
        InputError: the file has none.
    """
    content = read_plain(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: not an object of boxes by sample token")
    return content


def _true_rows(
    content: Mapping[str, Sequence[Box]],
    ego: Float[ndarray, "F 2"],
    path: Path,
    task: ObjectTask,
    classes: Sequence[str],
) -> ObjectRows:
    names, boxes = BoxNames(path, content), [box for frame_boxes in content.values() for box in frame_boxes]
    frame = np.repeat(np.arange(len(content)), [len(frame_boxes) for frame_boxes in content.values()])
    centre, size_lwh, yaw = read_geometry(boxes, names)
    columns: dict[str, ndarray] = {
        "velocity": read_velocities(boxes, names),
        "attribute": read_attributes(boxes, names),
        "num_points": read_points(boxes, names),
        "from_ego": centre[:, :2] - ego[frame],
    }
    identities = read_texts(boxes, "tracking_id", names) if task == "tracking" else []
    if task == "tracking":
        columns["track"] = number_names(identities)
    label = read_labels(boxes, _TRUE_NAMES, classes, {*DETECTION_CLASSES, RACK}, names)
    rows = make_rows(frame, label, centre, size_lwh, yaw, **columns)
    if task == "tracking":
        check_tracks(rows, identities, names)
    return rows


def _with_size(groups: Sequence[ObjectRows], path: Path) -> list[ObjectRows]:
    """Return the groups of a file's boxes without those that lack a size, which are counted in one line.

    Raises:
        InputError: no box has a size.
    """
    sized = [np.min(rows.size_lwh, axis=1) > 0 for rows in groups]
    given = sum(map(len, sized))
    tell_left_out(path, {"boxes without size": given - sum(int(kept.sum()) for kept in sized)}, given)
    return [rows[kept] for rows, kept in zip(groups, sized, strict=True)]


def _name(box: Box) -> object:
    return next((box[key] for key in _TRUE_NAMES if key in box), None)


def _sample(stated: Mapping[str, Any], boxes: Sequence[Box], where: str) -> Sample:
    """Return scene, time and ego vehicle as a sample, or else its boxes, state them."""
    box = boxes[0] if boxes else {}
    scene, time_us = (stated.get(key, box.get(key)) for key in ("scene_token", "timestamp"))
    if "ego_translation" in stated:
        ego: ndarray | None = read_numbers(stated, "ego_translation", 3, where)[:2]
    else:
        ego = _place(boxes, where)
    if time_us is not None and not isinstance(time_us, int):
        raise InputError(f"{where}: its timestamp is no whole number of microseconds")
    return Sample(None if scene is None else str(scene), time_us, ego)


def _place(boxes: Sequence[Box], where: str) -> Float[ndarray, "2"] | None:
    """Return the place of the ego vehicle from the first box that states its offset from it."""
    for n, box in enumerate(boxes):
        if "ego_translation" in box:
            offset = read_numbers(box, "ego_translation", 3, f"{where}, box {n}")
            if offset.any():  # the devkit writes zeros where it does not know
                return (read_numbers(box, "translation", 3, f"{where}, box {n}") - offset)[:2]
    return None


def _in_time(samples: Mapping[str, Sample], path: Path) -> list[str]:
    """Return the frames by scene, in the order in which scenes appear, and time.

    Raises:
        InputError: a scene or a time is missing, or two frames of a scene have the same time.
    """
    for name, sample in samples.items():
        if sample.scene is None or sample.time_us is None:
            raise InputError(
                f"{path}: frame {name} has no scene_token and timestamp, in its boxes or under `samples`: "
                "tracking needs them"
            )
    # Scenes in order of appearance, frames by time
    place = {scene: n for n, scene in enumerate(dict.fromkeys(sample.scene for sample in samples.values()))}
    ordered = sorted(samples, key=lambda name: (place[samples[name].scene], samples[name].time_us))
    for before, name in itertools.pairwise(ordered):
        if (samples[before].scene, samples[before].time_us) == (samples[name].scene, samples[name].time_us):
            raise InputError(f"{path}: frames {before} and {name} have the same scene and time")
    return ordered
