"""Folders with a transforms.json of nerfstudio: images with poses and pinhole calibrations.

A camera's frame there has x to the right, y up and z back (OpenGL), and the world's z is up. There is no
vehicle: the ego frame is that of a vehicle that carries the camera level at `HEIGHT_M` and looks ahead along
it. Lengths are the file's units, which are metres only if its poses were scaled so.
"""

import itertools
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from py123d.datatypes import LogMetadata

from foredrive.data.camera_streams import CameraSpec
from foredrive.data.log_paths import LogPath
from foredrive.data.own_logs import write_log
from foredrive.data.raw.raw_log import RawLog, folders_with
from foredrive.errors import InputError

HEIGHT_M, PERIOD_S = 1.5, 0.1
"""Height of the camera above the ground, and the time between frames without times."""

_SPLIT = "own_train"
_FILE = "transforms.json"
_PINHOLE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
_INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_T_EGO_CAM = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, HEIGHT_M], [0, 0, 0, 1]], np.float64)
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def find_nerfstudio(source: Path) -> Iterator[RawLog]:
    """Yield the folders that have a transforms.json."""
    for folder in folders_with(source, _FILE):
        yield RawLog(folder, NerfstudioLog(folder))


@dataclass(frozen=True)
class NerfstudioLog:
    """One folder, as a log that writes itself."""

    folder: Path

    def get_log_metadata(self) -> LogMetadata:
        """Return split and name of the log: that of the folder."""
        return LogMetadata("own", _SPLIT, self.folder.resolve().name, location=None)

    def write(self, out: Path, tick: Callable[[], None]) -> LogPath:
        """Write the images in the order of their times, or of their names where there are none."""
        frames = sorted(self._frames, key=lambda one: (one.t_s or 0.0, one.file.name))
        timed = all(one.t_s is not None for one in frames)
        groups = [
            list(found) for _, found in itertools.groupby(frames, lambda one: one.t_s if timed else id(one))
        ]
        kinds = list(dict.fromkeys(one.intrinsics for one in frames))
        names = ["front"] if len(kinds) == 1 else [f"camera_{number}" for number in range(len(kinds))]
        if any(len({one.intrinsics for one in group}) < len(group) for group in groups):
            raise InputError(f"{self.folder / _FILE}: two images of one camera have the same time")
        rig = [self._camera(name, kind) for name, kind in zip(names, kinds, strict=True)]
        if any(len(group) > 1 for group in groups):
            rig = self._rig(rig, kinds, groups)
        T_cam_ego = {kind: np.linalg.inv(one.T_ego_cam) for kind, one in zip(kinds, rig, strict=True)}
        T_world_ego = np.stack([group[0].T_world_cam @ T_cam_ego[group[0].intrinsics] for group in groups])
        images: dict[str, list[Path | None]] = {name: [] for name in names}
        for group in groups:
            files = {one.intrinsics: one.file for one in group}
            for name, kind in zip(names, kinds, strict=True):
                images[name].append(files.get(kind))
            tick()
        t_s = np.array(
            [group[0].t_s if timed else PERIOD_S * k for k, group in enumerate(groups)], np.float64
        )
        name = self.get_log_metadata().log_name
        return write_log(out, name, t_s, T_world_ego, cameras=rig, images=images, split=_SPLIT)

    def _camera(self, name: str, intrinsics: tuple[float, ...]) -> CameraSpec:
        width, height, fx, fy, cx, cy, *dist = intrinsics
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        return CameraSpec(name, K, _T_EGO_CAM, (int(height), int(width)), dist=np.array(dist))

    @staticmethod
    def _rig(
        rig: list[CameraSpec], kinds: list[tuple[float, ...]], groups: list[list["_Frame"]]
    ) -> list[CameraSpec]:
        """Place cameras that are exposed together by their poses at the first time at which all are there."""
        whole = max(groups, key=len)
        first = np.linalg.inv(whole[0].T_world_cam)
        T = {one.intrinsics: _T_EGO_CAM @ first @ one.T_world_cam for one in whole}
        return [
            CameraSpec(spec.name, spec.K, T.get(kind, _T_EGO_CAM), spec.size_hw, dist=spec.dist)
            for spec, kind in zip(rig, kinds, strict=True)
        ]

    @cached_property
    def _frames(self) -> list["_Frame"]:
        """Read and check the file.

        Raises:
            InputError: an entry is missing or wrong, a lens is no pinhole, an image lies elsewhere.
        """
        file = self.folder / _FILE
        whole = json.loads(file.read_text())
        if not isinstance(whole, dict) or not isinstance(whole.get("frames"), list) or not whole["frames"]:
            raise InputError(f"{file}: it has no frames")
        return [
            _frame(self.folder, whole, entry, f"{file}, frame {k}") for k, entry in enumerate(whole["frames"])
        ]


@dataclass(frozen=True)
class _Frame:
    file: Path
    T_world_cam: Float64[np.ndarray, "4 4"]
    t_s: float | None
    intrinsics: tuple[float, ...]


def _frame(folder: Path, shared: dict[str, Any], entry: Any, where: str) -> _Frame:
    if not isinstance(entry, dict):
        raise InputError(f"{where}: not an object of entries")
    found = shared | entry
    model = found.get("camera_model", "OPENCV")
    if model not in _PINHOLE:
        raise InputError(f"{where}: cameras of the model {model!r} are not read; undistort the images first")
    for key in ("file_path", "transform_matrix", *_INTRINSICS):
        if key not in found:
            raise InputError(f"{where}: {key} is missing")
    values = [_number(found.get(key, 0.0), key, where) for key in (*_INTRINSICS, *_DISTORTION)]
    if min(values[:4]) <= 0:
        raise InputError(f"{where}: sizes and focal lengths must be above 0")
    if found.get("k4"):
        raise InputError(f"{where}: k4 is not read; undistort the images first")
    t_s = next((_number(found[key], key, where) for key in ("timestamp", "time") if key in found), None)
    return _Frame(_inside(folder, found["file_path"], where), _pose(found, where), t_s, tuple(values))


def _number(value: Any, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{where}: {key} must be a finite number")
    return float(value)


def _pose(found: dict[str, Any], where: str) -> Float64[np.ndarray, "4 4"]:
    try:
        T = np.array(found["transform_matrix"], np.float64)
    except (ValueError, TypeError) as error:
        raise InputError(f"{where}: transform_matrix must be 4 rows of 4 numbers") from error
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{where}: transform_matrix must be 4 rows of 4 finite numbers")
    return T @ _OPENGL


def _inside(folder: Path, path: Any, where: str) -> Path:
    """Return the path of an image, which must lie in the folder."""
    root = os.path.abspath(folder)
    whole = os.path.abspath(os.path.join(root, str(path)))
    if os.path.commonpath([root, whole]) != root:
        raise InputError(f"{where}: the image {str(path)!r} lies outside of the folder")
    return Path(whole)
