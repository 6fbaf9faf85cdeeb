"""Folders with a transforms.json of nerfstudio: images with poses and pinhole calibrations.

A camera's frame there has x to the right, y up and z back (OpenGL), and the world's z is up. There is no
vehicle: the ego frame is that of a vehicle that carries the camera with most images level at `HEIGHT_M` and
looks ahead along it. Lengths are the file's units, which are metres only if its poses were scaled so. Which
image is of which camera is found by `camera_split`.
"""

import dataclasses
import json
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64, UInt8
from py123d.datatypes import LogMetadata

from foredrive.data.camera_streams import CameraSpec
from foredrive.data.ego_path import MAX_GAP_S, in_holes, interpolated_poses
from foredrive.data.formats.camera_split import PosedImage, RigCamera, split_into_cameras
from foredrive.data.formats.guard import DEFAULT_PERIOD_S, PartReader, PartSequence, nearest_parts
from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.images import check_size, decoded, read_rgb
from foredrive.data.log_paths import LogPath
from foredrive.data.notices import note
from foredrive.data.own_logs import write_log
from foredrive.errors import InputError

HEIGHT_M = 1.5
"""Height of the camera above the ground."""

_SPLIT = "own_train"
_FILE = "transforms.json"
_PINHOLE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_OTHER_LENS = re.compile("fish|equirect|omni|spheric|panoram|ftheta|f_theta", re.IGNORECASE)
"""Entries of transforms.json in any dialect that say, if they are set, that a lens is no pinhole."""
_INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_CAMERA_KEYS = ("camera_id", "camera_name", "camera_label", "camera", "cam_id", "cam", "sensor_id")
"""Entries of a frame that name its camera."""
_T_EGO_CAM = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, HEIGHT_M], [0, 0, 0, 1]], np.float64)
# From OpenGL's camera axes (x right, y up, z back) to x right, y down, z ahead
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_RANGE_IMAGES, _RANGE_PERCENT = 20, (0.1, 99.9)
"""Images of a camera with 16 bits whose values are looked at, and the percentiles that become 0 and 255."""


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
        """Write the images in the order of their times, or of the numbers in their names without times."""
        # Cameras with constant mounts, the one with most images first
        cameras = split_into_cameras(self._frames, str(self.folder / _FILE))
        base = cameras[0]
        t_us, T_world_cam = _frames_of(cameras)
        rig, images, image_t_s = [], {}, {}
        for camera in cameras:
            T_ego_cam = _T_EGO_CAM @ camera.T_base_cam
            spec = _camera(camera.name, camera.lens, T_ego_cam)
            files, times_us = _beside(camera, t_us)
            images[camera.name] = _ImageFiles(self.folder, spec, files)
            images[camera.name].check()
            image_t_s[camera.name] = times_us * 1e-6
            rig.append(spec)
        return write_log(
            out,
            self.get_log_metadata().log_name,
            t_us * 1e-6,
            # The vehicle is where the base camera is, without its mount
            T_world_cam @ np.linalg.inv(_T_EGO_CAM),
            cameras=rig,
            images=images,
            image_t_s=image_t_s,
            path=(base.t_us * 1e-6, base.T_world_cam @ np.linalg.inv(_T_EGO_CAM)),
            split=_SPLIT,
            tick=tick,
        )

    @cached_property
    def _frames(self) -> list[PosedImage]:
        """Read and check the file.

        Raises:
            InputError: an entry is missing or wrong, a lens is no pinhole, an image lies elsewhere.
        """
        file = self.folder / _FILE
        whole = json.loads(file.read_bytes())  # bytes may begin with a byte order mark
        if not isinstance(whole, dict) or not isinstance(whole.get("frames"), list) or not whole["frames"]:
            raise InputError(f"{file}: it has no frames")
        frames = [
            _frame(self.folder, whole, entry, f"{file}, frame {k}") for k, entry in enumerate(whole["frames"])
        ]
        return _in_seconds(frames, normalised=any("time" in entry for entry in whole["frames"]))


class _ImageFiles(PartSequence):
    """The images of a camera, read when they are asked for. One that cannot be read is None."""

    def __init__(self, folder: Path, spec: CameraSpec, files: list[Path | None]) -> None:
        super().__init__(spec.name, "images", len(files))
        self._folder, self._size_hw, self._files = folder, spec.size_hw, files
        self._range = self._value_range(spec.name)

    def _part(self, frame: int) -> Any:
        file = self._files[frame]
        return None if file is None else self._read(self._name(file), lambda: self._image(file))

    def _image(self, file: Path) -> UInt8[np.ndarray, "H W 3"]:
        return check_size(read_rgb(file, self._range), self._size_hw)

    def _name(self, file: Path) -> str:
        return os.path.relpath(file, self._folder)

    def _value_range(self, name: str) -> tuple[float, float] | None:
        """Return the range of grey values of a camera with more than 8 bits, and note it; None for others."""
        files = [file for file in self._files if file is not None]
        # Images spread over the sequence
        rows = np.unique(np.linspace(0, len(files) - 1, _RANGE_IMAGES).round().astype(int))
        read = PartReader(name, "images")
        values = []
        for file in [files[row] for row in rows]:
            pixels = read(self._name(file), lambda file=file: decoded(file))  # type: ignore[misc]
            if pixels is not None and pixels.ndim == 3:
                return None
            values += [] if pixels is None else [pixels.reshape(-1)]
        if not values:
            return None
        # Percentiles instead of extremes, so that single pixels do not set the range
        low, high = np.percentile(np.concatenate(values), _RANGE_PERCENT)
        note(name, f"images of more than 8 bits; {low:g} became 0 and {high:g} became 255")
        return float(low), float(high)


def _frames_of(cameras: list[RigCamera]) -> tuple[Int64[np.ndarray, "T"], Float64[np.ndarray, "T 4 4"]]:
    """Return times and poses of the frames: those of the first camera, and of other images between them."""
    base = cameras[0]
    # Images of other cameras between those of the base camera make frames of their own
    half_us = _half_period_us(base.t_us)
    others = np.unique(np.concatenate([camera.t_us for camera in cameras]))
    off_us = np.abs(others[:, None] - base.t_us[None]).min(axis=1)
    inside = (others > base.t_us[0]) & (others < base.t_us[-1])
    added = others[inside & (off_us > half_us)]
    holes = in_holes(base.t_us, base.T_world_cam, added)
    for t_us in added[holes].tolist():
        text = f"images of others between those of {base.name} more than {MAX_GAP_S:g} s apart, left out"
        note("frames", text, f"{t_us * 1e-6:.3f} s")
    t_us = np.union1d(base.t_us, added[~holes])
    # A single image has no motion to interpolate
    if len(base.t_us) == 1:
        return t_us, base.T_world_cam
    return t_us, interpolated_poses(base.t_us, base.T_world_cam, t_us.astype(np.float64))


def _beside(
    camera: RigCamera, t_us: Int64[np.ndarray, "T"]
) -> tuple[list[Path | None], Int64[np.ndarray, "T"]]:
    """Return the image of a camera beside each frame, and its time; that of the frame where there is none."""
    nearest, near = nearest_parts(camera.t_us, t_us)
    files = [
        camera.files[k] if exists else None for k, exists in zip(nearest.tolist(), near.tolist(), strict=True)
    ]
    for file in sorted(set(camera.files) - {file for file in files if file is not None}):
        note(camera.name, "images without a frame beside them, left out", file.name)
    return files, np.where(near, camera.t_us[nearest], t_us)


def _half_period_us(t_us: Int64[np.ndarray, "T"]) -> float:
    return 0.5 * float(np.median(np.diff(t_us))) if len(t_us) > 1 else 0.0


def _camera(name: str, lens: tuple[float, ...], T_ego_cam: Float64[np.ndarray, "4 4"]) -> CameraSpec:
    width, height, fx, fy, cx, cy, *dist = lens
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return CameraSpec(name, K, T_ego_cam, (int(height), int(width)), dist=np.array(dist))


def _in_seconds(frames: list[PosedImage], normalised: bool) -> list[PosedImage]:
    """Return the frames with times in s.

    The entry `time` is that of D-NeRF, which is 0 at the first and 1 at the last image, or -1 and 1, whatever
    the drive lasted. They are scaled as if images were `DEFAULT_PERIOD_S` apart, as those without times.

    Args:
        frames: of one file.
        normalised: whether their times may be such ones.
    """
    times = np.unique([frame.t_s for frame in frames if frame.t_s is not None])
    if len(times) < 2 or times[0] < -1 or times[-1] > 1:
        return frames
    scale = DEFAULT_PERIOD_S / float(np.median(np.diff(times)))
    if not normalised:
        if times[-1] == 1 and times[0] in (0, -1):
            note(
                _FILE,
                f"times from {times[0]:g} to exactly 1 were read as seconds; normalised?",
            )
        return frames
    note(
        _FILE,
        f"entries `time` run from {times[0]:g} to {times[-1]:g}, as normalised ones; "
        f"they were scaled so that images are {DEFAULT_PERIOD_S:g} s apart (`timestamp` is in seconds)",
    )
    return [
        frame if frame.t_s is None else dataclasses.replace(frame, t_s=(frame.t_s - float(times[0])) * scale)
        for frame in frames
    ]


def _frame(folder: Path, shared: dict[str, Any], entry: Any, where: str) -> PosedImage:
    if not isinstance(entry, dict):
        raise InputError(f"{where}: not an object of entries")
    # Entries of a frame take precedence over those of the file
    merged = shared | entry
    _check_lens(merged, where)
    for key in ("file_path", "transform_matrix", *_INTRINSICS):
        if key not in merged:
            raise InputError(f"{where}: {key} is missing")
    values = [_number(merged.get(key, 0.0), key, where) for key in (*_INTRINSICS, *_DISTORTION)]
    # w, h, fl_x and fl_y
    if min(values[:4]) <= 0:
        raise InputError(f"{where}: sizes and focal lengths must be above 0")
    t_s = next((_number(merged[key], key, where) for key in ("timestamp", "time") if key in merged), None)
    camera = next((str(entry[key]) for key in _CAMERA_KEYS if isinstance(entry.get(key), str | int)), None)
    file = _inside(folder, merged["file_path"], where)
    path = os.path.relpath(file, folder)
    return PosedImage(file, path, _pose(merged, where), t_s, tuple(values), camera)


def _check_lens(merged: dict[str, Any], where: str) -> None:
    """Check that a lens is a pinhole with OpenCV's five coefficients, in the words of any program.

    Raises:
        InputError: it is another one.
    """
    model = str(merged.get("camera_model", "OPENCV"))
    # Any entry that names another lens and is set
    flags = [key for key, value in merged.items() if _OTHER_LENS.search(key) and value]
    if model.upper() not in _PINHOLE or flags:
        what = flags[0] if flags else f"the model {model!r}"
        raise InputError(f"{where}: cameras of {what} are not read; undistort the images first")
    for key in ("k4", "k5", "k6"):
        if merged.get(key):
            raise InputError(f"{where}: {key} is not read; undistort the images first")


def _number(value: Any, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{where}: {key} must be a finite number")
    return float(value)


def _pose(entry: dict[str, Any], where: str) -> Float64[np.ndarray, "4 4"]:
    try:
        T = np.array(entry["transform_matrix"], np.float64)
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
