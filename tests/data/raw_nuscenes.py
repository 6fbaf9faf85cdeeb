"""One scene in nuScenes' format: two key frames and the sweeps between them, after its published tables."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

SCENE, START_US, SPEED_MPS = "scene-0103", 1_533_000_000_000_000, 4.0
CAMERAS = ("CAM_FRONT", "CAM_BACK", "CAM_FRONT_LEFT", "CAM_BACK_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT")
UPRIGHT = [1.0, 0.0, 0.0, 0.0]
AHEAD = [0.5, -0.5, 0.5, -0.5]
"""Of cameras: z ahead, x to the right."""


def write(root: Path, version: str = "v1.0-mini") -> None:
    """The vehicle drives along x at 4 m/s; a car 10 m ahead of its start drives at 2 m/s."""
    tables: dict[str, list[dict[str, Any]]] = {"sample_data": [], "ego_pose": [], "calibrated_sensor": []}
    tables["visibility"] = [{"token": "4", "level": "v80-100", "description": ""}]
    tables["attribute"] = [{"token": "att", "name": "vehicle.moving", "description": ""}]
    tables["category"] = [{"token": "cat", "name": "vehicle.car", "description": ""}]
    tables["instance"] = [
        {
            "token": "inst",
            "category_token": "cat",
            "nbr_annotations": 2,
            "first_annotation_token": "ann0",
            "last_annotation_token": "ann1",
        }
    ]
    tables["sensor"] = [
        {"token": name, "channel": name, "modality": "lidar" if name == "LIDAR_TOP" else "camera"}
        for name in ("LIDAR_TOP", *CAMERAS)
    ]
    tables["log"] = [
        {
            "token": "log",
            "logfile": "l",
            "vehicle": "n",
            "date_captured": "d",
            "location": "singapore-onenorth",
        }
    ]
    tables["map"] = [
        {"token": "map", "category": "semantic_prior", "filename": "maps/m.png", "log_tokens": ["log"]}
    ]
    tables["scene"] = [
        {
            "token": "scene",
            "log_token": "log",
            "nbr_samples": 2,
            "first_sample_token": "s0",
            "last_sample_token": "s1",
            "name": SCENE,
            "description": "",
        }
    ]
    tables["sample"] = [
        {
            "token": f"s{k}",
            "timestamp": START_US + 500_000 * k,
            "prev": "s0" if k else "",
            "next": "" if k else "s1",
            "scene_token": "scene",
        }
        for k in range(2)
    ]
    tables["sample_annotation"] = [
        {
            "token": f"ann{k}",
            "sample_token": f"s{k}",
            "instance_token": "inst",
            "visibility_token": "4",
            "attribute_tokens": ["att"],
            "translation": [10.0 + k, 2.0, 0.8],
            "size": [1.8, 4.2, 1.6],
            "rotation": UPRIGHT,
            "prev": "ann0" if k else "",
            "next": "" if k else "ann1",
            "num_lidar_pts": 5,
            "num_radar_pts": 0,
        }
        for k in range(2)
    ]
    for name in ("LIDAR_TOP", *CAMERAS):
        is_lidar = name == "LIDAR_TOP"
        tables["calibrated_sensor"].append(
            {
                "token": f"cal-{name}",
                "sensor_token": name,
                "translation": [1.0, 0.0, 1.8],
                "rotation": UPRIGHT if is_lidar else AHEAD,
                "camera_intrinsic": [] if is_lidar else [[50, 0, 16], [0, 50, 8], [0, 0, 1]],
            }
        )
        _stream(root, tables, name, [50_000 * k for k in range(11)] if is_lidar else [0, 500_000])
    folder = root / version
    folder.mkdir(parents=True)
    for table, rows in tables.items():
        folder.joinpath(f"{table}.json").write_text(json.dumps(rows))
    (root / "maps").mkdir()
    Image.new("L", (4, 4)).save(root / "maps" / "m.png")


def _stream(root: Path, tables: dict[str, list[dict[str, Any]]], name: str, at_us: list[int]) -> None:
    """The files of a sensor, each with its pose and its place in the chain."""
    tokens = [f"{name}-{t}" for t in at_us]
    for k, (token, t_us) in enumerate(zip(tokens, at_us, strict=True)):
        key = t_us % 500_000 == 0
        ending = "pcd.bin" if name == "LIDAR_TOP" else "jpg"
        file = Path("samples" if key else "sweeps") / name / f"{token}.{ending}"
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        if name == "LIDAR_TOP":
            np.array([[5, 1, -1, 20, 3], [8, 0, 0, 30, 4]], np.float32).tofile(root / file)
        else:
            Image.new("RGB", (32, 16), (200, 10, 30)).save(root / file)
        tables["ego_pose"].append(
            {
                "token": f"pose-{token}",
                "timestamp": START_US + t_us,
                "translation": [SPEED_MPS * t_us * 1e-6, 0.0, 0.0],
                "rotation": UPRIGHT,
            }
        )
        tables["sample_data"].append(
            {
                "token": token,
                "sample_token": "s1" if t_us >= 500_000 else "s0",
                "ego_pose_token": f"pose-{token}",
                "calibrated_sensor_token": f"cal-{name}",
                "timestamp": START_US + t_us,
                "fileformat": ending,
                "is_key_frame": key,
                "height": 0 if name == "LIDAR_TOP" else 16,
                "width": 0 if name == "LIDAR_TOP" else 32,
                "filename": str(file),
                "prev": tokens[k - 1] if k else "",
                "next": tokens[k + 1] if k + 1 < len(tokens) else "",
            }
        )
