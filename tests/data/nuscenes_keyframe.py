"""The real key frame of nuScenes as a data set in nuScenes' format: its boxes, of an info file, as tables."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from foredrive.data.formats.nuscenes_names import NAME_OF_CATEGORY
from foredrive.data.formats.nuscenes_tables import matrix_of_row, pose_of_matrix
from foredrive.data.safe_pickle import load_pickle
from foredrive.scene import Category


def written_keyframe(
    real_data: Path, folder: Path, labels: Mapping[int, Mapping[str, Any]] | None = None
) -> Path:
    """Write the key frame below a folder, and return it.

    Args:
        real_data: folder of the real logs.
        labels: entries of `sample_annotation`, such as attributes and visibilities, by the row of the box.
    """
    source, root = real_data / "nuscenes" / "keyframe", folder / "keyframe"
    tables = root / "v1.0-keyframe"
    shutil.copytree(next(source.glob("v1.0-*")), tables)
    for file in [*source.glob("*.jpg"), *source.glob("*.bin")]:
        (root / file.name).symlink_to(file)
    rows = {file.stem: json.loads(file.read_bytes()) for file in tables.glob("*.json")}
    of = {name: {row["token"]: row for row in table} for name, table in rows.items()}
    for row in rows["sample_data"]:
        row["filename"] = Path(row["filename"]).name
    lidar = next(row for row in rows["sample_data"] if row["fileformat"] == "pcd")
    T_world_ego = matrix_of_row(of["ego_pose"][lidar["ego_pose_token"]])
    T_world_lidar = T_world_ego @ matrix_of_row(of["calibrated_sensor"][lidar["calibrated_sensor_token"]])
    info = load_pickle(next(source.glob("*.pkl")))
    names = {number: name for name, number in info["metainfo"]["categories"].items()}
    category = {row["name"]: row["token"] for row in rows["category"]}
    rows["log"] = [{"token": row["log_token"]} for row in rows["scene"]]
    rows["instance"], rows["sample_annotation"] = [], []
    for place, box in enumerate(info["data_list"][0]["instances"]):
        x, y, z, length, width, height, yaw = map(float, box["bbox_3d"])  # lidar frame, z of the centre
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:3, 3] = x, y, z
        pose = pose_of_matrix(T_world_lidar @ T)
        name = NAME_OF_CATEGORY[Category[names.get(box["bbox_label_3d"], "other").upper()]]
        rows["instance"].append({"token": str(place), "category_token": category[name]})
        rows["sample_annotation"].append(
            {
                "token": str(place),
                "sample_token": rows["sample"][0]["token"],
                "instance_token": str(place),
                "translation": pose.array[:3].tolist(),
                "rotation": pose.array[3:].tolist(),
                "size": [width, length, height],
                "num_lidar_pts": int(box["num_lidar_pts"]),
                "attribute_tokens": [],
                **(labels or {}).get(place, {}),
            }
        )
    for name, table in rows.items():
        (tables / f"{name}.json").write_text(json.dumps(table))
    return root
