"""Ground truth from nuScenes' own tables (v1.0-*/*.json), without the devkit.

Source: nuscenes-devkit 1.2.0, eval/common/loaders.py (load_gt, add_center_dist), eval/detection/utils.py,
nuscenes.py (box_velocity).
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from foredrive.data.formats.nuscenes_names import read_table
from foredrive.errors import InputError
from foredrive.tasks.files.frames_of_results import check_known_frames
from foredrive.tasks.objects.nuscenes_json import ObjectTask, Sample, make_truth
from foredrive.tasks.objects.truth import RACK, ObjectTruth

Row = Mapping[str, Any]
_CLASS_OF_CATEGORY = {
    "movable_object.barrier": "barrier",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.construction": "construction_vehicle",
    "vehicle.motorcycle": "motorcycle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "movable_object.trafficcone": "traffic_cone",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
    RACK: RACK,
}
"""Categories without a class are left out."""
_MAX_STEP_S = 1.5
"""Largest time between two annotations for a velocity; twice as long between those before and after."""


def find_tables(path: Path) -> Path | None:
    """Return the folder of tables: the path itself, or its only v1.0-* folder; None if it has none."""
    folders = [
        folder for folder in (path, *sorted(path.glob("v1.0-*"))) if (folder / "sample.json").is_file()
    ]
    if len(folders) > 1:
        raise InputError(f"{path}: several folders of tables; name one of {', '.join(map(str, folders))}")
    return folders[0] if folders else None


def read_tables_truth(
    folder: Path, listed: Iterable[str], path: Path, task: ObjectTask, classes: Sequence[str]
) -> ObjectTruth:
    """Read the ground truth of the scenes that results are of, all their samples.

    Args:
        listed: samples that the results list.
        path: of the results, for messages.

    Raises:
        InputError: a table cannot be read, or a sample is unknown.
    """
    samples = read_table(folder / "sample.json")
    check_known_frames(path, list(listed := list(listed)), folder, list(samples))
    # All samples of every scene that the results touch
    scenes = {samples[token]["scene_token"] for token in listed}
    wanted = {token: row for token, row in samples.items() if row["scene_token"] in scenes}
    ego = _ego_places(folder, wanted)
    described = {
        token: Sample(row["scene_token"], row["timestamp"], ego.get(token)) for token, row in wanted.items()
    }
    return make_truth(_boxes(folder, samples, wanted), described, folder, task, classes)


def _boxes(folder: Path, samples: Mapping[str, Row], wanted: Mapping[str, Row]) -> dict[str, list[Row]]:
    """Return annotations by sample, in nuScenes' format for results."""
    annotations = read_table(folder / "sample_annotation.json")
    category = {token: row["name"] for token, row in read_table(folder / "category.json").items()}
    class_of = {
        token: _CLASS_OF_CATEGORY.get(category[row["category_token"]])
        for token, row in read_table(folder / "instance.json").items()
    }
    attribute = {token: row["name"] for token, row in read_table(folder / "attribute.json").items()}
    content: dict[str, list[Row]] = {token: [] for token in wanted}
    for token, row in annotations.items():
        name = class_of[row["instance_token"]]
        if row["sample_token"] not in wanted or name is None:
            continue
        content[row["sample_token"]].append(
            {
                "translation": row["translation"],
                "size": row["size"],
                "rotation": row["rotation"],
                "velocity": _velocity(token, annotations, samples),
                "num_pts": row["num_lidar_pts"] + row["num_radar_pts"],
                "attribute_name": attribute[row["attribute_tokens"][0]] if row["attribute_tokens"] else "",
                "detection_name": name,
                "tracking_id": row["instance_token"],
            }
        )
    return content


def _velocity(token: str, annotations: Mapping[str, Row], samples: Mapping[str, Row]) -> list[float] | None:
    """Return the velocity over ground between the annotations before and after; None if it is not known."""
    row = annotations[token]
    # Annotations before and after, or the box itself at an end of its track
    first, last = row["prev"] or token, row["next"] or token
    if first == last:
        return None
    ends = [annotations[end] for end in (first, last)]
    times = [samples[end["sample_token"]]["timestamp"] for end in ends]
    # Seconds are rounded before the difference, as in the devkit
    step_s = 1e-6 * times[1] - 1e-6 * times[0]
    # Too long between two annotations: the velocity is unknown
    if step_s > (2 * _MAX_STEP_S if row["prev"] and row["next"] else _MAX_STEP_S):
        return None
    moved = np.subtract(ends[1]["translation"][:2], ends[0]["translation"][:2])
    velocity: list[float] = (moved / step_s).tolist()
    return velocity


def _ego_places(folder: Path, wanted: Mapping[str, Row]) -> dict[str, np.ndarray]:
    """Return the place of the ego vehicle over ground at each sample's lidar sweep."""
    # Places are those of the ego vehicle at the sweep of the top lidar
    lidars = {
        token for token, row in read_table(folder / "sensor.json").items() if row["channel"] == "LIDAR_TOP"
    }
    mounted = {
        token
        for token, row in read_table(folder / "calibrated_sensor.json").items()
        if row["sensor_token"] in lidars
    }
    poses = read_table(folder / "ego_pose.json")
    return {
        row["sample_token"]: np.array(poses[row["ego_pose_token"]]["translation"][:2], dtype=np.float64)
        for row in read_table(folder / "sample_data.json").values()
        if row["is_key_frame"] and row["sample_token"] in wanted and row["calibrated_sensor_token"] in mounted
    }
