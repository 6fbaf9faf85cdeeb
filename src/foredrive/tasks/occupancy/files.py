"""Folders of semantic voxels in the formats of Occ3D and OpenOcc: which frames there are, and their arrays.

Truth is `SCENE/TOKEN/labels.npz` with `semantics`, and beside it `mask_camera` and `mask_lidar` (Occ3D) or
`flow` (OpenOcc). A prediction is `TOKEN.npz`, or has the truth's layout; its classes are `semantics`, `pred`
or an array without a name, as the public scripts write them, and its velocities `flow`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation

from foredrive.errors import InputError
from foredrive.sensors.ray_origins import ray_origins
from foredrive.tasks.files.plain_files import read_plain
from foredrive.tasks.occupancy.arrays import array_names, read_labels, read_mask, read_velocities
from foredrive.tasks.occupancy.protocols import VOXEL_PROTOCOLS


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
    # mmdetection3d 1.1 and later store matrices
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
    # The name of an image file begins with the vehicle's name
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


PREDICTED_NAMES = ("semantics", "pred", "arr_0")
MASKS = ("mask_camera", "mask_lidar")


@dataclass(frozen=True)
class VoxelFrame:
    """The voxels of one frame, Z Y X."""

    predicted: UInt8[ndarray, "Z Y X"]
    true: UInt8[ndarray, "Z Y X"]
    seen_by_camera: Bool[ndarray, "Z Y X"]
    seen_by_lidar: Bool[ndarray, "Z Y X"]
    """Both are True everywhere where the data set has no masks."""
    predicted_mps: Float32[ndarray, "Z Y X 2"] | None
    """0 where the prediction has no velocities, as in the public code; None where the data set has none."""
    true_mps: Float32[ndarray, "Z Y X 2"] | None
    states_velocity: bool
    """Whether the prediction has velocities."""
    known: Bool[ndarray, "Z Y X"] | None = None
    """Voxels with truth. None: all of them."""


@dataclass(frozen=True)
class VoxelFiles:
    """The files of frames, by token, predictions and truth of the same frames."""

    data_set: str
    """occ3d or openocc."""
    results: Mapping[str, Path]
    truth: Mapping[str, Path]
    origins_m: Mapping[str, Float64[ndarray, "O 3"]] | None
    """The lidar's places of each frame; None without poses."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the names of the data set's classes."""
        return VOXEL_PROTOCOLS[self.data_set].classes


def find_voxels(results: Path, truth: Path, poses: Path | None = None) -> VoxelFiles:
    """Find the frames to be scored: those that `poses` lists, otherwise all of `truth`.

    Raises:
        InputError: a frame lacks its prediction or its truth, or the folders hold no such files.
    """
    places = None if poses is None else read_poses(poses)
    true = _labels_by_token(truth)
    if not true:
        raise InputError(f"{truth}: holds no SCENE/TOKEN/labels.npz")
    predicted = _results_by_token(results)
    # The frames to be scored, in the order of their list
    frames, listed = list(true if places is None else places), poses or truth
    if places is not None:
        absent = [token for token in frames if token not in true]
        if absent:
            raise InputError(
                f"{truth}: has no labels of frame {absent[0]}, which {poses} lists{_more(absent)}"
            )
    if predicted.keys().isdisjoint(frames):
        raise InputError(
            f"{results}: holds none of the {len(frames)} frames of {listed}: is it another split?"
        )
    unknown = sorted(predicted.keys() - set(frames))
    if unknown:
        raise InputError(f"{predicted[unknown[0]]}: {listed} has no frame {unknown[0]}{_more(unknown)}")
    missing = [token for token in frames if token not in predicted]
    if missing:
        raise InputError(f"{results}: has no prediction of frame {missing[0]} of {listed}{_more(missing)}")
    return VoxelFiles(
        data_set=_data_set(true[frames[0]]),
        results=predicted,
        truth={token: true[token] for token in frames},
        origins_m=None if places is None else _origins(places, true),
    )


def read_frame(files: VoxelFiles, token: str) -> VoxelFrame:
    """Read one frame.

    Raises:
        InputError: an array is missing, has another shape or holds an unknown class or, in a prediction, a
            velocity that is not finite. The message names the file and the array.
    """
    truth, result = files.truth[token], files.results[token]
    true = read_labels(truth, "semantics", files.classes)
    names = array_names(result)
    # The name of the array differs between public scripts
    name = next((name for name in PREDICTED_NAMES if name in names), None)
    if name is None:
        raise InputError(f"{result}: has no array named {', '.join(PREDICTED_NAMES[:-1])}")
    predicted = read_labels(result, name, files.classes)
    if files.data_set == "occ3d":
        camera, lidar = (read_mask(truth, mask) for mask in MASKS)
        return VoxelFrame(predicted, true, camera, lidar, None, None, states_velocity=False)
    # OpenOcc has no masks: all voxels count
    true_mps, seen = read_velocities(truth, "flow"), np.ones(true.shape, np.bool_)
    stated = "flow" in names
    predicted_mps = read_velocities(result, "flow") if stated else np.zeros_like(true_mps)
    if not np.isfinite(predicted_mps).all():
        raise InputError(f"{result}: flow: a velocity is not finite")
    return VoxelFrame(predicted, true, seen, seen, predicted_mps, true_mps, states_velocity=stated)


def _labels_by_token(folder: Path) -> dict[str, Path]:
    """Return the files SCENE/TOKEN/labels.npz by token."""
    by_token: dict[str, Path] = {}
    for path in sorted(folder.glob("*/*/labels.npz")):
        token = path.parent.name
        if token in by_token:
            raise InputError(f"{path}: frame {token} is also in {by_token[token].parent.parent}")
        by_token[token] = path
    return by_token


def _results_by_token(folder: Path) -> dict[str, Path]:
    flat = {path.stem: path for path in sorted(folder.glob("*.npz"))}
    by_token = flat or _labels_by_token(folder)
    if not by_token:
        raise InputError(f"{folder}: holds neither TOKEN.npz nor SCENE/TOKEN/labels.npz")
    return by_token


def _data_set(file: Path) -> str:
    names = array_names(file)
    if "flow" in names:
        return "openocc"
    if set(MASKS) <= names:
        return "occ3d"
    raise InputError(f"{file}: has neither {' and '.join(MASKS)} (Occ3D) nor flow (OpenOcc)")


def _origins(poses: Mapping[str, FramePose], truth: Mapping[str, Path]) -> dict[str, Float64[ndarray, "O 3"]]:
    """Return the lidar's places of each frame; frames of one scene folder are a drive."""
    drives: dict[str, list[str]] = {}
    # Frames in order of time, grouped by drive
    for token in sorted(poses, key=lambda token: poses[token].time):
        drives.setdefault(truth[token].parent.parent.name, []).append(token)
    origins: dict[str, Float64[ndarray, "O 3"]] = {}
    for tokens in drives.values():
        T_world_ego, T_ego_lidar = (
            np.stack([getattr(poses[token], name) for token in tokens])
            for name in ("T_world_ego", "T_ego_lidar")
        )
        origins |= {token: ray_origins(T_world_ego, T_ego_lidar, n) for n, token in enumerate(tokens)}
    return origins


def _more(tokens: list[str]) -> str:
    return f" (and {len(tokens) - 1} more)" if len(tokens) > 1 else ""
