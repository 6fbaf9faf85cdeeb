"""Folders of npz files in the layouts of Occ3D and OpenOcc, and files of poses beside them."""

import json
import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from foredrive.tasks.occupancy.protocols import OCC3D_CLASSES, OPENOCC_CLASSES

XYZ = (200, 200, 16)
LIDAR_M = [0.943713, 0.0, 1.84023]
OCC3D_FREE, OPENOCC_FREE = len(OCC3D_CLASSES) - 1, len(OPENOCC_CLASSES) - 1


def street(free: int, ground: int, wall: int, wall_x: int = 150) -> np.ndarray:
    """A flat road and a wall across it, X Y Z; the wall's cells begin at `wall_x`."""
    labels = np.full(XYZ, free, np.uint8)
    labels[:, :, :2] = ground
    labels[wall_x : wall_x + 3, :, 2:10] = wall
    return labels


def write_truth(folder: Path, scene: str, token: str, **arrays: np.ndarray) -> Path:
    path = folder / scene / token / "labels.npz"
    path.parent.mkdir(parents=True)
    np.savez_compressed(path, **arrays)
    return path


def write_result(folder: Path, token: str, *unnamed: np.ndarray, **arrays: np.ndarray) -> Path:
    folder.mkdir(exist_ok=True)
    np.savez_compressed(folder / f"{token}.npz", *unnamed, **arrays)
    return folder / f"{token}.npz"


def write_infos(file: Path, positions_m: Mapping[str, float]) -> Path:
    """Frames along world x, half a second apart in the order given, as nuScenes' infos have them."""
    infos = [
        {
            "token": token,
            "timestamp": 1_500_000_000_000_000 + 500_000 * n,
            "ego2global_translation": [x, 0.0, 0.0],
            "ego2global_rotation": [1.0, 0.0, 0.0, 0.0],
            "lidar2ego_translation": LIDAR_M,
            "lidar2ego_rotation": [0.5**0.5, 0.0, 0.0, -(0.5**0.5)],
            "gt_boxes": np.zeros((2, 7)),
        }
        for n, (token, x) in enumerate(positions_m.items())
    ]
    file.write_bytes(pickle.dumps({"infos": infos, "metadata": {"version": "v1.0-trainval"}}))
    return file


def write_annotations(
    file: Path, positions_m: Mapping[str, float], scene: str, vehicle: str = "n015"
) -> Path:
    """The same frames in Occ3D's annotations, as the validation split, beside a scene for training."""
    frames = {
        token: {
            "timestamp": str(1_500_000_000_000_000 + 500_000 * n),
            "camera_sensor": {"a camera": {"img_path": f"CAM_BACK/{vehicle}-2018-07-18__CAM_BACK__1.jpg"}},
            "ego_pose": {"translation": [x, 0.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0]},
        }
        for n, (token, x) in enumerate(positions_m.items())
    }
    content = {"val_split": [scene], "train_split": ["other"], "scene_infos": {scene: frames, "other": {}}}
    file.write_text(json.dumps(content))
    return file
