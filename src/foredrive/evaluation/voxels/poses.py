"""Where the lidar was in every key frame of a drive, from the files that come with nuScenes' occupancy."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from foredrive.errors import InputError
from foredrive.evaluation.plain_files import read_plain


@dataclass(frozen=True)
class FramePose:
    """The pose of one key frame."""

    time: float
    """Orders the frames of a drive; its unit is the file's."""
    T_world_ego: Float64[ndarray, "4 4"]
    T_ego_lidar: Float64[ndarray, "4 4"]


LIDAR_POSITION_M = {"n008": (0.985793, 0.0, 1.84019), "n015": (0.943713, 0.0, 1.84023)}
"""Position of LIDAR_TOP on nuScenes' two vehicles, in the ego frame. Occ3D's annotations do not state it."""


def read_poses(file: Path) -> dict[str, FramePose]:
    """Read the poses of key frames by token.

    Args:
        file: `nuscenes_infos_val.pkl` and the like, as mmdetection3d (of either format) and its kin make
            them, or Occ3D's `annotations.json`, of which the frames of `val_split` are read.

    Raises:
        InputError: the file is neither, or a pose cannot be read. The message names the frame.
    """
    content = read_plain(file, arrays=True)
    poses = _from_annotations(content, file) if file.suffix == ".json" else _from_infos(content, file)
    if not poses:
        raise InputError(f"{file}: holds no frames")
    return poses


def _from_infos(content: Any, file: Path) -> dict[str, FramePose]:
    frames = content.get("infos", content.get("data_list")) if isinstance(content, dict) else content
    if not isinstance(frames, list):
        raise InputError(f"{file}: has no list of frames under 'infos' or 'data_list'")
    poses: dict[str, FramePose] = {}
    for index, frame in enumerate(frames):
        try:
            poses[str(frame["token"])] = _pose_of_info(frame)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{file}: frame {index}: {_reason(error)}") from error
    return poses


def _pose_of_info(frame: Mapping[str, Any]) -> FramePose:
    """Return the pose of a frame: quaternions before mmdetection3d 1.1, matrices since."""
    time = float(frame["timestamp"])
    if "ego2global" in frame:
        return FramePose(time, _matrix(frame["ego2global"]), _matrix(frame["lidar_points"]["lidar2ego"]))
    ego, lidar = (
        _transform(frame[f"{name}_translation"], frame[f"{name}_rotation"])
        for name in ("ego2global", "lidar2ego")
    )
    return FramePose(time, ego, lidar)


def _from_annotations(content: Any, file: Path) -> dict[str, FramePose]:
    try:
        scenes: Mapping[str, Mapping[str, Any]] = {
            name: content["scene_infos"][name] for name in content["val_split"]
        }
    except (KeyError, TypeError) as error:
        raise InputError(f"{file}: not Occ3D's annotations: {_reason(error)}") from error
    poses: dict[str, FramePose] = {}
    for scene, frames in scenes.items():
        for token, frame in frames.items():
            try:
                poses[token] = _annotated_pose(frame)
            except (KeyError, TypeError, ValueError, StopIteration) as error:
                raise InputError(f"{file}: {scene}: frame {token}: {_reason(error)}") from error
    return poses


def _annotated_pose(frame: Mapping[str, Any]) -> FramePose:
    path = str(next(iter(frame["camera_sensor"].values()))["img_path"])
    vehicle = next((name for name in LIDAR_POSITION_M if name in path), None)
    if vehicle is None:
        raise ValueError(f"the name of image {path} begins with none of {', '.join(LIDAR_POSITION_M)}")
    T_ego_lidar = np.eye(4)
    T_ego_lidar[:3, 3] = LIDAR_POSITION_M[vehicle]
    pose = frame["ego_pose"]
    return FramePose(
        float(frame["timestamp"]), _transform(pose["translation"], pose["rotation"]), T_ego_lidar
    )


def _transform(translation_m: Any, rotation_wxyz: Any) -> Float64[ndarray, "4 4"]:
    translation, rotation = np.asarray(translation_m, np.float64), np.asarray(rotation_wxyz, np.float64)
    if translation.shape != (3,) or rotation.shape != (4,):
        raise ValueError("a pose is not three metres and a quaternion")
    if not (np.isfinite(translation).all() and np.isfinite(rotation).all()):
        raise ValueError("a pose is not finite")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(rotation, scalar_first=True).as_matrix()
    T[:3, 3] = translation
    return T


def _matrix(values: Any) -> Float64[ndarray, "4 4"]:
    T = np.asarray(values, np.float64)
    if T.shape != (4, 4):
        raise ValueError("a pose is not a matrix of 4 x 4")
    if not np.isfinite(T).all():
        raise ValueError("a pose is not finite")
    return T


def _reason(error: Exception) -> str:
    return f"has no {error}" if isinstance(error, KeyError) else (str(error) or "cannot be read")
