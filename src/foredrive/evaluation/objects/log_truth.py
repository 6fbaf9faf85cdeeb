"""Ground truth from 123D logs, at the frames that results name LOG@T_US."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch

from foredrive.data.boxes import read_boxes
from foredrive.errors import InputError
from foredrive.evaluation.frames_of_results import log_frames
from foredrive.evaluation.objects.truth import ObjectTruth, lacking
from foredrive.metrics.object_rows import Frames, ObjectRows, make_rows
from foredrive.scene import Boxes, Category


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
        rows.append(_rows(boxes, T_world_ego, len(names), classes))
        names.append(each.name)
        ego.append(T_world_ego[:2, 3])
        scene.append(each.drive)
        time_us.append(int(each.log.t_us[each.frame]))
    every = _stacked(rows)
    return ObjectTruth(
        names,
        every,
        every[np.zeros(0, np.int64)],
        Frames(np.array(scene, dtype=np.int64), np.array(time_us, dtype=np.int64)),
        np.array(ego).reshape(-1, 2),
        lacking(every),
    )


def _rows(boxes: Boxes, T_world_ego: np.ndarray, frame: int, classes: Sequence[str]) -> ObjectRows:
    kept = boxes[boxes.valid]
    label_of = {Category[name.upper()]: n for n, name in enumerate(classes)}
    R, ego = T_world_ego[:3, :3], T_world_ego[:3, 3]
    centre = kept.centre.double().numpy() @ R.T + ego
    yaw = kept.yaw.double().numpy() + np.arctan2(R[1, 0], R[0, 0])
    velocity = torch.nn.functional.pad(kept.velocity.double(), (0, 1)).numpy() @ R.T
    return make_rows(
        np.full(len(centre), frame),
        np.array([label_of.get(Category(int(c)), -1) for c in kept.category], dtype=np.int64),
        centre,
        kept.size_lwh.double().numpy(),
        yaw,
        velocity=velocity[:, :2],
        attribute=kept.attribute.numpy(),
        num_points=kept.num_points.numpy(),
        from_ego=centre[:, :2] - ego[:2],
        track=kept.track_id.numpy(),
    )


def _stacked(rows: Sequence[ObjectRows]) -> ObjectRows:
    if not rows:
        zero = np.zeros(0, np.int64)
        return make_rows(zero, zero, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    return ObjectRows(**{name: np.concatenate([vars(each)[name] for each in rows]) for name in vars(rows[0])})
