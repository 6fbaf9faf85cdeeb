"""Reads objects of results and of their ground truth, from every source."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from foredrive.tasks.files.frames_of_results import annotated_frames
from foredrive.tasks.objects.in_world import box_rows, stacked
from foredrive.tasks.objects.nuscenes_json import (
    ObjectTask,
    boxes_by_frame,
    read_json_truth,
    read_object,
    read_results,
    with_places_of_results,
)
from foredrive.tasks.objects.nuscenes_tables import find_tables, read_tables_truth
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES, MAX_BOXES, TRACKING_CLASSES, Frames
from foredrive.tasks.objects.truth import FoundObjects, ObjectTruth, lacking


def read_log_truth(folder: Path, listed: Iterable[str], path: Path, classes: Sequence[str]) -> ObjectTruth:
    """Read the boxes of logs, in their world frame, at the frames that a results file lists.

    Other frames of the logs are not evaluated: results are mostly of fewer frames than a log has.

    Args:
        folder: with logs, as `find_logs` takes it.
        listed: names of frames.
        path: of the results, for messages.

    Raises:
        InputError: a frame is not in the logs, or not annotated.
    """
    wanted = dict.fromkeys(listed)
    names: list[str] = []
    # Frames of the log have the log's world frame, so places of one drive are comparable
    rows, ego, scene, time_us = [], [], [], []
    for named, boxes in annotated_frames(folder, wanted, path):
        T_world_ego = named.log.T_world_ego[named.frame]
        rows.append(box_rows(boxes, T_world_ego, len(names), classes))
        names.append(named.name)
        ego.append(T_world_ego[:2, 3])
        scene.append(named.drive)
        time_us.append(int(named.log.t_us[named.frame]))
    every = stacked(rows)
    return ObjectTruth(
        names,
        every,
        every[np.zeros(0, np.int64)],
        Frames(np.array(scene, dtype=np.int64), np.array(time_us, dtype=np.int64)),
        np.array(ego).reshape(-1, 2),
        lacking(every),
    )


def read_objects(results: Path, truth: Path, task: ObjectTask) -> tuple[FoundObjects, ObjectTruth]:
    """Read a results file of nuScenes and its ground truth: JSON, nuScenes' tables, or 123D logs.

    Raises:
        InputError: a file cannot be read, or a box is wrong; the message names the first.
    """
    classes = DETECTION_CLASSES if task == "detection" else TRACKING_CLASSES
    if truth.is_file():
        true = read_json_truth(truth, task, classes)
    else:
        listed = boxes_by_frame(results, read_object(results))
        tables = find_tables(truth)
        if tables is None:
            true = read_log_truth(truth, listed, results, classes)
        else:
            true = read_tables_truth(tables, listed, results, task, classes)
    if np.isnan(true.ego).any():
        true = with_places_of_results(true, results)
    predicted = read_results(results, true, truth, task, classes, MAX_BOXES)
    return predicted, true
