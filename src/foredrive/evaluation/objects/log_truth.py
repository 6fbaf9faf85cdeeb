"""Ground truth from 123D logs, at the frames that results name LOG@T_US."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from foredrive.data.boxes import read_boxes
from foredrive.errors import InputError
from foredrive.evaluation.frames_of_results import log_frames
from foredrive.evaluation.objects.in_world import box_rows, stacked
from foredrive.evaluation.objects.truth import ObjectTruth, lacking
from foredrive.metrics.object_rows import Frames


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
    rows, ego, scene, time_us = [], [], [], []
    for each in log_frames(folder, wanted, path):
        boxes = read_boxes(each.log, each.frame)
        if boxes is None:
            raise InputError(f"{path}: frame {each.name} is not annotated in {each.log.path.folder}")
        T_world_ego = each.log.T_world_ego[each.frame]
        rows.append(box_rows(boxes, T_world_ego, len(names), classes))
        names.append(each.name)
        ego.append(T_world_ego[:2, 3])
        scene.append(each.drive)
        time_us.append(int(each.log.t_us[each.frame]))
    every = stacked(rows)
    return ObjectTruth(
        names,
        every,
        every[np.zeros(0, np.int64)],
        Frames(np.array(scene, dtype=np.int64), np.array(time_us, dtype=np.int64)),
        np.array(ego).reshape(-1, 2),
        lacking(every),
    )
