"""Read files of detections of any known format, and write the scores of their frames."""

import json
import math
from collections.abc import Iterable
from pathlib import Path

from foredrive.errors import InputError
from foredrive.evaluation.detections.coco_results import read_coco
from foredrive.evaluation.detections.frames import DetectionSet
from foredrive.evaluation.detections.kitti_labels import read_kitti
from foredrive.evaluation.detections.nuscenes_results import read_nuscenes
from foredrive.evaluation.detections.score import FrameScore
from foredrive.evaluation.plain_files import read_plain
from foredrive.files import atomic_path
from foredrive.sets import Family


def read_detections(results: Path, truth: Path, family: Family = "gaussian") -> DetectionSet:
    """Read detections and truth: two folders of KITTI's text, or JSON of nuScenes or COCO.

    `family` is that of the box densities.

    Raises:
        InputError: a file cannot be read. The message names it.
    """
    if results.is_dir() and truth.is_dir():
        read = read_kitti(results, truth, family)
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


def write_frame_scores(path: Path, scores: Iterable[FrameScore]) -> None:
    """Write one JSON object a line for `search.scores`: a frame's name, its NLL and the NLL's parts, in nats.

    Infinity, which JSON lacks, is written as text ("inf").
    """
    with atomic_path(path) as temporary, temporary.open("w") as file:
        for score in scores:
            parts = {"nll": score.nll, **score.parts}
            values = {name: value if math.isfinite(value) else str(value) for name, value in parts.items()}
            file.write(json.dumps({"frame": score.name, **values}) + "\n")
