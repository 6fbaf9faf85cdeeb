"""Read files of detections of any known format, and write the scores of their frames.

COCO's results are a list of records with `image_id`, `category_id`, `bbox` (x, y, width, height in px) and
`score`, or an object with this list under `annotations`; its truth is in the instances format. Records of
other categories than the truth's are left out, as pycocotools does, and so are boxes without width or height.
Beyond the format, a record may have `covariance` (of x1, y1, x2, y2 in px) and `class_probabilities` (by
category name).
"""

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.scene import Category
from foredrive.scene.boxes import UNKNOWN
from foredrive.sets import Family
from foredrive.tasks.detection.frames import (
    STD_OF_SIDE,
    STD_PX,
    DetectionFrame,
    DetectionSet,
    StatedDetections,
    enclosing_region,
    make_detections,
    make_objects,
    read_class_probabilities,
    read_covariances,
    read_relevance,
)
from foredrive.tasks.detection.kitti_labels import read_kitti
from foredrive.tasks.detection.nuscenes_results import read_nuscenes
from foredrive.tasks.detection.score import FrameScore
from foredrive.tasks.files.frames_of_results import annotated_frames
from foredrive.tasks.files.plain_files import read_number_rows, read_numbers, read_plain, tell_left_out
from foredrive.tasks.objects.in_world import ego_yaw, places_in_world
from foredrive.tasks.objects.nuscenes_json import boxes_by_frame
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES

Record = Mapping[str, Any]


def read_coco(
    results: Sequence[Any], truth: Mapping[str, Any], path: Path, truth_path: Path, family: Family
) -> DetectionSet:
    """Return the images of the truth, in its order, without crowds.

    Raises:
        InputError: a record is wrong. The message names the first.
    """
    images, categories = _named(truth, "images", truth_path), _named(truth, "categories", truth_path)
    label_of = {category["id"]: n for n, category in enumerate(categories)}
    classes = [str(category.get("name", category["id"])) for category in categories]
    if len(set(classes)) < len(classes):
        raise InputError(f"{truth_path}: two categories have the same name")
    # Records by image, with their numbers for messages
    predicted: dict[Any, list[tuple[int, Record]]] = defaultdict(list)
    true: dict[Any, list[tuple[int, Record]]] = defaultdict(list)
    crowds = 0
    for n, record in enumerate(_listed(truth, "annotations", truth_path)):
        if record.get("iscrowd"):
            crowds += 1
        else:
            true[_key(record, "image_id")].append((n, record))
    others = 0
    for n, record in enumerate(results):
        category = _key(record, "category_id")
        others += category is not None and category not in label_of
        # Records of other categories are left out, as pycocotools does
        if category is None or category in label_of:
            predicted[_key(record, "image_id")].append((n, record))
    image_ids = {image["id"] for image in images}
    # A wrong image or category is an error, not a record to leave out
    for records, where in ((predicted, path), (true, truth_path)):
        for image_id, members in records.items():
            if image_id not in image_ids:
                raise InputError(f"{where}: record {members[0][0]} is of the unknown image {image_id}")
            for n, record in members:
                if _key(record, "category_id") not in label_of:
                    raise InputError(
                        f"{where}: record {n} has the unknown category {record.get('category_id')}"
                    )
    sizeless, true_sizeless = (
        _drop_sizeless(side, where) for side, where in ((predicted, path), (true, truth_path))
    )
    tell_left_out(path, {"boxes of other categories": others, "boxes without size": sizeless}, len(results))
    true_boxes = sum(len(members) for members in true.values())
    tell_left_out(truth_path, {"boxes without size": true_sizeless}, true_boxes + true_sizeless)
    counts = {
        "frames_without_detections": len(image_ids - set(predicted)),
        "boxes_without_covariance": sum(record.get("covariance") is None for record in results),
        "crowds_left_out": crowds,
        "boxes_of_other_classes_left_out": others,
        "boxes_without_size_left_out": sizeless,
        # Frames come in the order of the images, also those without records
        "true_boxes_without_size_left_out": true_sizeless,
    }
    frames = [
        _frame(image, predicted[image["id"]], true[image["id"]], label_of, classes, path, truth_path, family)
        for image in images
    ]
    return DetectionSet(frames, classes, False, counts, len(classes))


def _frame(
    image: Record,
    predicted: Sequence[tuple[int, Record]],
    true: Sequence[tuple[int, Record]],
    label_of: Mapping[Any, int],
    classes: Sequence[str],
    path: Path,
    truth_path: Path,
    family: Family,
) -> DetectionFrame:
    where = f"{truth_path}: image {image['id']}"
    corners, true_corners = _corners(predicted, path), _corners(true, truth_path)
    records = [record for _, record in predicted]
    names, true_names = (
        [f"{path}: record {n}" for n, _ in predicted],
        [f"{truth_path}: record {n}" for n, _ in true],
    )
    label = [label_of[record["category_id"]] for record in records]
    share = read_class_probabilities(records, label, classes, names)
    covariance = read_covariances(records, _defaults(corners), names)
    score = read_number_rows(records, "score", 1, names)[:, 0]
    true_label = [label_of[record["category_id"]] for _, record in true]
    for key in ("height", "width"):
        if key not in image:
            raise InputError(
                f"{where} has no {key}: the likelihood of missed objects needs `width` and `height` (px) of "
                "each record under `images`"
            )
    height, width = (read_numbers(image, key, 1, where)[0] for key in ("height", "width"))
    if not (height > 0 and width > 0):
        raise InputError(f"{where} has the size {width:g} x {height:g}")
    return DetectionFrame(
        str(image.get("file_name", image["id"])),
        str(image.get("sequence", image["id"])),
        make_detections(names, score, share, corners, covariance, family=family),
        make_objects(true_names, true_label, true_corners),
        # Objects that no detection explains lie in the image
        *enclosing_region(np.zeros(4), np.array([width, height, width, height]), true_corners),
        relevance=read_relevance([record for _, record in true], true_names),
        stated=StatedDetections(np.array(label, dtype=np.int64), score, np.ones(len(label), bool)),
    )


def _key(record: Any, name: str) -> int | str | None:
    """Return the id under `name`; None if the record has none."""
    key = record.get(name) if isinstance(record, dict) else None
    return key if isinstance(key, int | str) else None


def _drop_sizeless(records_of: dict[Any, list[tuple[int, Record]]], path: Path) -> int:
    """Remove the boxes whose width or height is 0, and return their number."""
    dropped = 0
    for image_id, members in records_of.items():
        names = [f"{path}: record {n}" for n, _ in members]
        size = read_number_rows([record for _, record in members], "bbox", 4, names)[:, 2:]
        empty = (size == 0).any(1)
        records_of[image_id] = [member for member, out in zip(members, empty, strict=True) if not out]
        dropped += int(empty.sum())
    return dropped


def _corners(records: Sequence[tuple[int, Record]], path: Path) -> Float[ndarray, "n 4"]:
    bbox = read_number_rows(
        [record for _, record in records], "bbox", 4, [f"{path}: record {n}" for n, _ in records]
    )
    wrong = np.flatnonzero(~(bbox[:, 2:] > 0).all(1))
    if len(wrong):
        width, height = bbox[wrong[0], 2:]
        raise InputError(
            f"{path}: record {records[wrong[0]][0]} has a bbox of the size {width:g} x {height:g}"
        )
    return np.concatenate([bbox[:, :2], bbox[:, :2] + bbox[:, 2:]], axis=1)


def _defaults(corners: Float[ndarray, "n 4"]) -> Float[ndarray, "n 4 4"]:
    # Standard deviations of x1, x2 scale with the width, those of y1, y2 with the height
    side = np.tile(corners[:, 2:] - corners[:, :2], 2)
    # Two independent parts, added in quadrature
    return np.eye(4) * ((STD_OF_SIDE * side) ** 2 + STD_PX**2)[:, None, :]


def _listed(content: Mapping[str, Any], key: str, path: Path) -> list[Any]:
    records = content.get(key)
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise InputError(f"{path}: has no list of {key}")
    return records


def _named(content: Mapping[str, Any], key: str, path: Path) -> list[Any]:
    """Return records after checking that their ids are unique."""
    records, names = _listed(content, key, path), set()
    for n, record in enumerate(records):
        name = _key(record, "id")
        if name is None or name in names:
            raise InputError(f"{path}: {key} {n} has {'no id' if name is None else f'the id {name} again'}")
        names.add(name)
    return records


def read_detections(results: Path, truth: Path, family: Family = "gaussian") -> DetectionSet:
    """Read detections and truth: two folders of KITTI's text, or JSON of nuScenes or COCO.

    The truth of nuScenes' results may be a folder of 123D logs, whose frames are named LOG@T_US. `family` is
    that of the box densities.

    Raises:
        InputError: a file cannot be read. The message names it.
    """
    if results.is_dir() and truth.is_dir():
        read = read_kitti(results, truth, family)
    elif truth.is_dir():
        predicted = read_plain(results)
        if not isinstance(predicted, dict):
            raise InputError(f"{results}: a truth of logs needs an object of boxes by sample (nuScenes)")
        true = boxes_of_logs(truth, boxes_by_frame(results, predicted), results)
        read = read_nuscenes(predicted, true, results, truth, family)
    else:
        predicted, true = read_plain(results), read_plain(truth)
        if not isinstance(true, dict):
            raise InputError(f"{truth}: neither an object of boxes by sample (nuScenes) nor of images (COCO)")
        if isinstance(predicted, dict) and isinstance(predicted.get("annotations"), list):
            predicted = predicted["annotations"]
        if isinstance(predicted, dict):
            read = read_nuscenes(predicted, true, results, truth, family)
        elif isinstance(predicted, list):
            read = read_coco(predicted, true, results, truth, family)
        else:
            raise InputError(f"{results}: neither a list (COCO) nor an object of boxes by sample (nuScenes)")
    if not read.frames:
        raise InputError(f"{truth}: holds no frames")
    if not read.classes:
        raise InputError(f"neither {results} nor {truth} holds any box")
    return read


def boxes_of_logs(folder: Path, listed: Iterable[str], path: Path) -> dict[str, list[Record]]:
    """Return the true boxes of logs in nuScenes' format, in the logs' world frames.

    Args:
        folder: with logs, as `find_logs` takes it.
        listed: names of frames, LOG@T_US.
        path: of the results, for messages.

    Raises:
        InputError: a frame is not in the logs, or not annotated.
    """
    frames: dict[str, list[Record]] = {}
    for named, boxes in annotated_frames(folder, dict.fromkeys(listed), path):
        kept, T_world_ego = boxes[boxes.valid], named.log.T_world_ego[named.frame]
        centre = places_in_world(kept.centre.double().numpy(), T_world_ego)
        half_yaw = 0.5 * (kept.yaw.double().numpy() + ego_yaw(T_world_ego))
        columns = zip(
            (Category(kind).name.lower() for kind in kept.category.tolist()),
            centre.tolist(),
            (centre - T_world_ego[:3, 3]).tolist(),
            kept.size_lwh.double().numpy()[:, [1, 0, 2]].tolist(),
            np.stack([np.cos(half_yaw), 0 * half_yaw, 0 * half_yaw, np.sin(half_yaw)], -1).tolist(),
            kept.num_points.tolist(),
            strict=True,
        )
        frames[named.name] = [
            {
                "detection_name": name,
                "translation": translation,
                "ego_translation": from_ego,
                "size": size,
                "rotation": rotation,
                "scene_token": named.log.path.name,
            }
            | ({} if points == UNKNOWN else {"num_pts": points})
            for name, translation, from_ego, size, rotation, points in columns
            if name in DETECTION_CLASSES
        ]
    return frames


def write_frame_scores(path: Path, scores: Iterable[FrameScore]) -> None:
    """Write one JSON object a line for `search.scores`: a frame's name, its NLL and the NLL's parts, in nats.

    Infinity, which JSON lacks, is written as text ("inf").
    """
    with atomic_path(path) as temporary, temporary.open("w") as file:
        for score in scores:
            parts = {"nll": score.nll, **score.parts}
            values = {name: value if math.isfinite(value) else str(value) for name, value in parts.items()}
            file.write(json.dumps({"frame": score.name, **values}) + "\n")
