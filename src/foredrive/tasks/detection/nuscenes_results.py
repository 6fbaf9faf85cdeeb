"""3-D detections in nuScenes' results format, and truth in the same.

A file has lists of boxes by sample token: under `results`, or alone, as the devkit's `EvalBoxes.serialize`
writes them. A box has `translation` (m, global), `size` (w, l, h in m), `rotation` (quaternion w x y z),
`detection_name` and `detection_score`. Boxes without length, width or height are left out.

Beyond the format, a detection may have `covariance` (of centre and log l, w, h in m), `yaw_std` (rad) and
`class_probabilities` (by name). Truth may have `num_pts` and `ego_translation`, as the devkit writes them,
`scene_token`, `relevance`, and boxes with the name `BICYCLE_RACK`, which are no objects.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.scene.boxes import UNKNOWN
from foredrive.sets import Family, MultiBernoulli
from foredrive.tasks.detection.frames import (
    STD_LOG_SIZE,
    STD_M,
    STD_YAW_RAD,
    DetectionFrame,
    DetectionSet,
    StatedDetections,
    enclosing_region,
    make_detections,
    make_objects,
    order_classes,
    read_class_probabilities,
    read_covariances,
    read_relevance,
)
from foredrive.tasks.detection.protocols import DETECTION_PROTOCOLS
from foredrive.tasks.files.plain_files import read_number_rows, read_numbers, tell_left_out
from foredrive.tasks.objects.nuscenes_json import boxes_by_frame, read_geometry
from foredrive.tasks.objects.object_rows import ObjectRows, counted, make_rows

LOWER = np.array([-60.0, -60.0, -10.0, -3.0, -3.0, -3.0])
UPPER = np.array([60.0, 60.0, 10.0, 4.0, 4.0, 4.0])
"""Region of objects: around the ego vehicle, or the middle of the frame's boxes, in m and log m."""
DEFAULT_COVARIANCE = np.diag(np.square([*STD_M, *[STD_LOG_SIZE] * 3]))
BICYCLE_RACK = "static_object.bicycle_rack"

Box = Mapping[str, Any]


def read_nuscenes(
    results: Mapping[str, Any], truth: Mapping[str, Any], path: Path, truth_path: Path, family: Family
) -> DetectionSet:
    """Return the frames of the truth, in its order.

    Raises:
        InputError: a record is wrong. The message names the first.
    """
    # Frames are matched by sample token; results may lack frames, but not have others
    found_boxes, true = _by_frame(results, path), _by_frame(truth, truth_path)
    unknown = sorted(set(found_boxes) - set(true))
    if unknown:
        raise InputError(f"{path}: frame {unknown[0]} ({len(unknown)} in all) is not in {truth_path}")
    true_names, names = (
        {box["detection_name"] for boxes in side.values() for box in boxes} for side in (true, found_boxes)
    )
    # Bicycle racks are no objects: they only exclude detections near them
    classes, true_classes = order_classes(true_names - {BICYCLE_RACK}, names)
    frames = []
    sizeless, true_sizeless = 0, 0
    for token, boxes in true.items():
        predicted = _Boxes.of(found_boxes.get(token, ()), f"{path}: frame {token}")
        objects = _Boxes.of(boxes, f"{truth_path}: frame {token}")
        sizeless += len(found_boxes.get(token, ())) - len(predicted.records)
        true_sizeless += len(boxes) - len(objects.records)
        frames.append(_frame(token, predicted, objects, classes, family))
    for where, given, left_out in ((path, found_boxes, sizeless), (truth_path, true, true_sizeless)):
        tell_left_out(where, {"boxes without size": left_out}, sum(map(len, given.values())))
    counts = {
        "frames_without_detections": len(set(true) - set(found_boxes)),
        "boxes_without_covariance": sum(
            box.get("covariance") is None for boxes in found_boxes.values() for box in boxes
        ),
        "frames_without_ego": sum(frame.range_m is None for frame in frames),
        "boxes_without_size_left_out": sizeless,
        "true_boxes_without_size_left_out": true_sizeless,
    }
    return DetectionSet(frames, classes, True, counts, true_classes)


@dataclass(frozen=True)
class _Boxes:
    """Boxes of one frame that have a size, with the ego vehicle's place if the file has it."""

    records: Sequence[Box]
    names: Sequence[str]
    state: Float[ndarray, "n 6"]
    """Centre (m, global) and log length, width, height (m)."""
    yaw: Float[ndarray, "n"]
    ego: Float[ndarray, "3"] | None

    @classmethod
    def of(cls, records: Sequence[Box], where: str) -> "_Boxes":
        names = [f"{where}, box {n}" for n in range(len(records))]
        centre, size_lwh, yaw = read_geometry(records, names)
        # Log sizes need positive sizes, so boxes without them are left out
        sized = np.min(size_lwh, axis=1) > 0
        state = np.concatenate([centre[sized], np.log(size_lwh[sized])], axis=1)
        # All boxes serve to find the ego vehicle, also those without size
        ego = _ego(records, centre, names)
        return cls(list(compress(records, sized)), list(compress(names, sized)), state, yaw[sized], ego)

    def __getitem__(self, which: Bool[ndarray, "n"]) -> "_Boxes":
        records, names = list(compress(self.records, which)), list(compress(self.names, which))
        return _Boxes(records, names, self.state[which], self.yaw[which], self.ego)

    def labels(self, classes: Sequence[str]) -> list[int]:
        return [classes.index(box["detection_name"]) for box in self.records]

    def count_in_precision(self, ego: Float[ndarray, "3"] | None, racks: "_Boxes") -> Bool[ndarray, "n"]:
        """Return whether nuScenes' protocol counts each box. Without the ego vehicle, ranges are unknown."""
        protocol = DETECTION_PROTOCOLS["nuscenes"]
        return counted(
            self.rows(protocol.classes, ego), racks.rows((), ego), protocol.region, protocol.classes
        )

    def rows(self, classes: Sequence[str], ego: Float[ndarray, "3"] | None) -> ObjectRows:
        """Return the boxes as rows of one frame; the label of a class that is not among `classes` is -1."""
        number = {name: n for n, name in enumerate(classes)}
        label = np.array([number.get(box["detection_name"], -1) for box in self.records], dtype=np.int64)
        points = np.array([box.get("num_pts", UNKNOWN) for box in self.records], dtype=np.int64)
        # An unknown ego vehicle makes all ranges NaN
        place = np.full(3, np.nan) if ego is None else ego
        return make_rows(
            np.zeros(len(label), np.int64),
            label,
            self.state[:, :3],
            np.exp(self.state[:, 3:]),
            self.yaw,
            num_points=points,
            from_ego=self.state[:, :2] - place[:2],
        )


def _frame(
    token: str, predicted: _Boxes, true: _Boxes, classes: Sequence[str], family: Family
) -> DetectionFrame:
    sequence = str(true.records[0].get("scene_token", token)) if true.records else token
    is_rack = np.array([box["detection_name"] == BICYCLE_RACK for box in true.records], bool)
    racks, true = true[is_rack], true[~is_rack]
    ego = predicted.ego if true.ego is None else true.ego
    # Without an ego vehicle, the region lies about the middle of all boxes
    every = np.concatenate([true.state, predicted.state])[:, :3]
    origin = ego if ego is not None else every.mean(0) if len(every) else np.zeros(3)
    # Move the boxes to the region's origin: only positions shift, not log sizes
    shift = np.concatenate([origin, np.zeros(3)])
    true_state = true.state - shift
    seen = [
        read_numbers(box, "num_pts", 1, name)[0] if "num_pts" in box else np.nan
        for box, name in zip(true.records, true.names, strict=True)
    ]
    score = read_number_rows(predicted.records, "detection_score", 1, predicted.names)[:, 0]
    label = predicted.labels(classes)
    return DetectionFrame(
        token,
        sequence,
        _detections(predicted, predicted.state - shift, score, classes, family),
        make_objects(true.names, true.labels(classes), true_state, true.yaw),
        *enclosing_region(LOWER, UPPER, true_state),
        range_m=None if ego is None else np.linalg.norm(true_state[:, :2], axis=1),
        visibility=np.array(seen),
        relevance=read_relevance(true.records, true.names),
        stated=StatedDetections(
            np.array(label, dtype=np.int64), score, predicted.count_in_precision(ego, racks)
        ),
        object_counts=true.count_in_precision(ego, racks),
    )


def _detections(
    boxes: _Boxes,
    state: Float[ndarray, "M 6"],
    score: Float[ndarray, "M"],
    classes: Sequence[str],
    family: Family,
) -> MultiBernoulli:
    records, names = boxes.records, boxes.names
    yaw_std = [{"yaw_std": box.get("yaw_std", STD_YAW_RAD)} for box in records]
    return make_detections(
        names,
        score,
        read_class_probabilities(records, boxes.labels(classes), classes, names),
        state,
        read_covariances(records, np.tile(DEFAULT_COVARIANCE, (len(records), 1, 1)), names),
        boxes.yaw,
        read_number_rows(yaw_std, "yaw_std", 1, names)[:, 0],
        family=family,
    )


def _by_frame(content: Mapping[str, Any], path: Path) -> dict[str, Sequence[Box]]:
    boxes = boxes_by_frame(path, content)
    for token, frame_boxes in boxes.items():
        for n, box in enumerate(frame_boxes):
            if not isinstance(box.get("detection_name"), str):
                raise InputError(f"{path}: frame {token}, box {n} has no detection_name")
    return boxes


def _ego(
    boxes: Sequence[Box], centre: Float[ndarray, "n 3"], names: Sequence[str]
) -> Float[ndarray, "3"] | None:
    """Return the ego vehicle's place if the first box has it. The devkit writes zeros if it is unknown."""
    if not boxes or "ego_translation" not in boxes[0]:
        return None
    offset = read_numbers(boxes[0], "ego_translation", 3, names[0])
    return centre[0] - offset if offset.any() else None
