"""Logs from the user's own sensor data: images, calibration, poses, sweeps and boxes.

The frame of the ego vehicle is on the ground below the middle of the rear axle: x ahead, y to the left, z up.
Camera frames have x to the right, y down and z ahead. The world frame is any frame with z up.
"""

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64, Shaped, UInt8
from py123d.datatypes import EgoStateSE3Metadata
from py123d.geometry import PoseSE3

from foredrive.data.camera_streams import CameraSpec
from foredrive.data.category_names import category_named
from foredrive.data.ego_path import MAX_GAP_S, interpolated_poses
from foredrive.data.images import read_rgb, whole_jpeg
from foredrive.data.log_paths import LogPath
from foredrive.data.log_writer import Frame, LogWriter
from foredrive.errors import InputError
from foredrive.scene import Boxes, Category, LidarSweep
from foredrive.scene.boxes import unlabelled

Num = Shaped[np.ndarray, "..."]
RGB = UInt8[np.ndarray, "H W 3"]
Exposure = tuple[int, Float64[np.ndarray, "4 4"]]
"""Time (µs) of an image, and pose of the vehicle."""
DATASET = "own"
_MAX_S = 1e11
"""Times beyond the year 5000 are in another unit."""


@dataclass(frozen=True)
class Vehicle:
    """The recording vehicle. The default is a car of middle size."""

    length_m: float = 4.6
    width_m: float = 1.85
    height_m: float = 1.5
    wheelbase_m: float = 2.75
    axle_to_centre_m: float = 1.35
    """Distance from the rear axle to the middle of the vehicle."""


@dataclass(frozen=True)
class Points:
    """The returns of one sweep, [N] values each. `write_log` checks their shapes."""

    xyz_m: Num
    """[N, 3] in the ego frame: that of the frame's time if they are compensated, else of their own time."""
    intensity: Num | None = None
    """0 to 1."""
    dt_s: Num | None = None
    """Time of each point relative to that of the frame. None: all are measured at once."""
    channel: Num | None = None
    """Number of the laser, 0 to 255."""
    compensated: bool = True
    """Whether the vehicle's motion within the sweep has been removed. Otherwise `write_log` removes it."""


@dataclass(frozen=True)
class Box:
    """One labelled object."""

    category: str
    """A name of `foredrive.scene.Category`, or a usual name of public data sets such as vehicle.car."""
    track_id: int
    """Constant for one object within the log."""
    centre_m: tuple[float, float, float]
    """Centre of the box (not of its bottom) in the ego frame."""
    size_lwh_m: tuple[float, float, float]
    yaw_rad: float
    """Heading about z; 0 is ahead, counter-clockwise."""
    velocity_mps: tuple[float, float] | None = None
    """Velocity over ground along the ego axes. None: it follows from the track."""


def write_log(
    out: Path | str,
    name: str,
    t_s: Num,
    T_world_ego: Num,
    *,
    cameras: Sequence[CameraSpec] = (),
    images: Mapping[str, Sequence[Path | str | bytes | Num | None]] | None = None,
    image_t_s: Mapping[str, Num] | None = None,
    image_mounts: Mapping[str, Num] | None = None,
    sweeps: Sequence[Points | LidarSweep | None] | None = None,
    lidar_position_m: tuple[float, float, float] = (0.0, 0.0, 1.8),
    boxes: Sequence[Sequence[Box] | None] | None = None,
    vehicle: Vehicle = Vehicle(),
    path: tuple[Num, Num] | None = None,
    split: str = "own_train",
    tick: Callable[[], None] = lambda: None,
) -> LogPath:
    """Write sensor data as a 123D log. An existing log of the same name is replaced.

    All sequences have one entry for each of T frames, and None where a frame lacks it. They are read one
    entry at a time, so a sequence may load its entries when they are read, which limits the memory.
    Velocities and accelerations are differences to the previous frame, and contain nothing of later frames.
    Images are stored as JPEG; those that are JPEGs are kept as they are.

    Args:
        out: 123D data root; the log is out/logs/SPLIT/NAME.
        name: of the log: letters, digits, dots, dashes and underscores.
        t_s: [T] time of each frame, increasing.
        T_world_ego: [T, 4, 4] pose of the vehicle at these times.
        cameras: their calibration, at most 11.
        images: by camera: image files, their bytes, or uint8 RGB arrays [H, W, 3].
        image_t_s: by camera: time at which the middle row of each image was exposed. Default: that of the
            frame. Poses between frames are interpolated.
        image_mounts: by camera that moves on the vehicle: T_ego_cam [T, 4, 4].
        sweeps: points of the lidar, whose beams that did not return are unknown; or whole sweeps, unbatched,
            in the ego frame at the frame's time, where they are known if there are any.
        lidar_position_m: of the lidar, in the ego frame.
        boxes: labels at each frame. None where a frame is not annotated, empty where nothing is there.
        vehicle: size of the recording vehicle.
        path: times [P] and poses [P, 4, 4] of the vehicle at a higher rate. They give its pose at the times
            of images and points between the frames. Default: those of the frames.
        split: a name that ends in _train, _val or _test.
        tick: called after each frame.

    Raises:
        InputError: numbers of entries differ, times do not increase, an image cannot be read or has another
            size than its camera, an array has another shape, a value is not finite, a category is unknown.
    """
    if not re.fullmatch(r"[\w-][\w.-]*", name):
        raise InputError(f"the name of a log has letters, digits, dots, dashes and underscores; not {name!r}")
    drive = _Drive.of(name, np.asarray(t_s, np.float64), np.asarray(T_world_ego, np.float64))
    if path is not None:
        denser = _Drive.of(f"{name}, path", *(np.asarray(values, np.float64) for values in path))
        drive = dataclasses.replace(drive, denser=denser)
    # All checks that need no file come before the first frame is written
    _check_cameras(name, cameras)
    images, image_t_s, image_mounts = images or {}, image_t_s or {}, image_mounts or {}
    given: dict[str, Sequence[Any] | np.ndarray | None] = {"sweeps": sweeps, "boxes": boxes, **image_t_s}
    given |= {f"mounts of {camera}": mounts for camera, mounts in image_mounts.items()}
    _check_counts(
        name, len(drive.t_us), given | {f"images of {camera}": rows for camera, rows in images.items()}
    )
    _check_image_times(name, images, image_t_s)
    for camera, mounts in image_mounts.items():
        if not all(_is_rotation(T) for T in np.asarray(mounts, np.float64)):
            raise InputError(f"{name}: a mount of {camera} is no rotation")
    exposed = {camera: drive.exposures(np.asarray(times)) for camera, times in image_t_s.items()}
    for spec in cameras:
        if spec.name in image_mounts:
            exposed[spec.name] = _moved(
                exposed.get(spec.name) or drive.exposures(t_s), spec, image_mounts[spec.name]
            )
    place = (Path(out), split, name, list(cameras), None, None, None)
    with LogWriter(*place, vehicle=_metadata(vehicle), dataset=DATASET) as writer:
        for frame in range(len(drive.t_us)):
            where = f"{name}, frame {frame}"
            points = None if sweeps is None else sweeps[frame]
            labels = None if boxes is None else boxes[frame]
            shown = {camera: rows[frame] for camera, rows in images.items()}
            sensed = Frame(
                t_us=int(drive.t_us[frame]),
                T_world_ego=drive.T_world_ego[frame],
                velocity_ego_mps=drive.velocity_ego_mps[frame],
                acceleration_ego_mps2=drive.acceleration_ego_mps2[frame],
                images={name: _rgb(image, where) for name, image in shown.items() if image is not None},
                sweep=None if points is None else _sweep(points, drive, frame, lidar_position_m, where),
                boxes=None if labels is None else _boxes(labels, where),
                exposed={camera: times[frame] for camera, times in exposed.items()},
                misses_known=isinstance(points, LidarSweep) and not bool(points.returned.all()),
            )
            writer.write(sensed)
            tick()
    return LogPath(writer.folder.absolute(), Path(out).absolute() / "maps")


def _check_counts(name: str, frames: int, given: Mapping[str, Sequence[Any] | np.ndarray | None]) -> None:
    for what, values in given.items():
        if values is not None and len(values) != frames:
            raise InputError(f"{name}: {len(values)} entries in {what}, but {frames} frames")


def _check_image_times(name: str, images: Mapping[str, Any], image_t_s: Mapping[str, Num]) -> None:
    for camera, times in image_t_s.items():
        if camera not in images:
            raise InputError(f"{name}: image_t_s has times of {camera!r}, but there are no images of it")
        if not np.isfinite(np.asarray(times, np.float64)).all():
            raise InputError(f"{name}: a time of {camera} in image_t_s is not finite")


@dataclass(frozen=True)
class _Drive:
    """Times and motion of the vehicle."""

    t_us: np.ndarray
    T_world_ego: Float64[np.ndarray, "T 4 4"]
    velocity_ego_mps: Float64[np.ndarray, "T 3"]
    acceleration_ego_mps2: Float64[np.ndarray, "T 3"]
    denser: "_Drive | None" = None
    """Poses at a higher rate, for times between the frames."""

    @classmethod
    def of(cls, name: str, t_s: Num, T_world_ego: Num) -> "_Drive":
        """Check times and poses, and derive the motion."""
        if t_s.ndim != 1 or T_world_ego.shape != (len(t_s), 4, 4) or not len(t_s):
            shapes = f"{list(t_s.shape)} and {list(T_world_ego.shape)}"
            raise InputError(f"{name}: t_s must be [T] and T_world_ego [T, 4, 4]; they are {shapes}")
        if not (np.isfinite(t_s).all() and np.isfinite(T_world_ego).all()):
            raise InputError(f"{name}: a time or a pose is not finite")
        if np.abs(t_s).max() > _MAX_S:
            raise InputError(f"{name}: times are in seconds; {np.abs(t_s).max():g} s may be in ns, ms or µs")
        t_us = np.round(t_s * 1e6).astype(np.int64)  # Whole µs: the product may be off by a fraction
        if (np.diff(t_us) < 1).any():
            raise InputError(f"{name}: times must increase, by a microsecond at least")
        R = T_world_ego[:, :3, :3]
        if not np.allclose(R @ R.mT, np.eye(3), atol=1e-3) or (np.linalg.det(R) < 0).any():
            raise InputError(f"{name}: T_world_ego holds a matrix that is no rotation")
        if not np.allclose(T_world_ego[:, 3], [0, 0, 0, 1], atol=1e-6):
            raise InputError(f"{name}: the last row of each T_world_ego must be 0, 0, 0, 1")
        velocity = _rates(T_world_ego[:, :3, 3], t_us)
        acceleration = _rates(velocity, t_us)
        return cls(
            t_us,
            T_world_ego,
            # Rᵀ v: from world to ego axes
            np.einsum("tji,tj->ti", R, velocity),
            np.einsum("tji,tj->ti", R, acceleration),
        )

    def poses_at(self, t_us: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 4 4"]:
        """Return poses between the frames, and by the last step's motion beyond them."""
        if self.denser is not None:
            return self.denser.poses_at(t_us)
        times_us, T = self.t_us, self.T_world_ego
        if len(times_us) == 1:
            return np.repeat(T, len(t_us), axis=0)
        # The first and the last step are repeated beyond the ends
        before, after = T[0] @ np.linalg.inv(T[1]) @ T[0], T[-1] @ np.linalg.inv(T[-2]) @ T[-1]
        times_us = np.concatenate(
            [[2 * times_us[0] - times_us[1]], times_us, [2 * times_us[-1] - times_us[-2]]]
        )
        return interpolated_poses(times_us, np.concatenate([before[None], T, after[None]]), t_us)

    def exposures(self, t_s: Float64[np.ndarray, "T"]) -> list[Exposure]:
        """Return time (µs) and pose at times at which images were taken."""
        t_us = np.round(t_s * 1e6)
        return list(zip(t_us.astype(np.int64).tolist(), self.poses_at(t_us), strict=True))


def _moved(exposed: list[Exposure], spec: CameraSpec, T_ego_cam: Num) -> list[Exposure]:
    """Return the exposures with the vehicle moved, so that the camera's mount puts it where it was."""
    T_ego_moved = np.asarray(T_ego_cam) @ np.linalg.inv(spec.T_ego_cam)
    return [(t_us, T @ moved) for (t_us, T), moved in zip(exposed, T_ego_moved, strict=True)]


def _rates(values: Float64[np.ndarray, "T 3"], t_us: Int64[np.ndarray, "T"]) -> Float64[np.ndarray, "T 3"]:
    """Return the rate of change (per s) since the frame before; the first frame's is that of the second.

    A frame behind a gap of more than `MAX_GAP_S` is a first one.
    """
    if len(t_us) == 1:
        return np.zeros_like(values)
    dt_s = np.diff(t_us) * 1e-6
    rate = np.diff(values, axis=0) / dt_s[:, None]
    for hole in np.flatnonzero(dt_s[:-1] > MAX_GAP_S)[::-1]:
        rate[hole] = rate[hole + 1]
    return np.concatenate([rate[:1], rate])


def _check_cameras(name: str, cameras: Sequence[CameraSpec]) -> None:
    """Check calibrations before anything is written."""
    for spec in cameras:
        K, T, dist = (
            np.asarray(values, np.float64)
            for values in (spec.K, spec.T_ego_cam, 0.0 if spec.dist is None else spec.dist)
        )
        if K.shape != (3, 3) or T.shape != (4, 4):
            raise InputError(f"{name}: K of {spec.name} must be [3, 3] and T_ego_cam [4, 4]")
        if not all(np.isfinite(values).all() for values in (K, T, dist)) or not np.isfinite(spec.readout_s):
            raise InputError(f"{name}: the calibration of {spec.name} is not finite")
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise InputError(f"{name}: the focal lengths of {spec.name} must be above 0")
        if not _is_rotation(T):
            raise InputError(f"{name}: T_ego_cam of {spec.name} holds a matrix that is no rotation")


def _is_rotation(T: Float64[np.ndarray, "4 4"]) -> bool:
    """Return whether a pose turns, and does not mirror or scale."""
    return bool(np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3) and np.linalg.det(T[:3, :3]) > 0)


def _metadata(vehicle: Vehicle) -> EgoStateSE3Metadata:
    return EgoStateSE3Metadata(
        vehicle_name="own",
        length=vehicle.length_m,
        width=vehicle.width_m,
        height=vehicle.height_m,
        wheel_base=vehicle.wheelbase_m,
        center_to_imu_se3=PoseSE3(vehicle.axle_to_centre_m, 0.0, vehicle.height_m / 2, 1.0, 0.0, 0.0, 0.0),
        rear_axle_to_imu_se3=PoseSE3.identity(),
    )


def _rgb(image: Path | str | bytes | Num, where: str) -> RGB | bytes:
    """Return an image, read from its file if it is one. A JPEG stays as it is."""
    if isinstance(image, np.ndarray):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise InputError(
                f"{where}: an image must be uint8 [H, W, 3], not {image.dtype} {list(image.shape)}"
            )
        return image
    jpeg = whole_jpeg(image)
    return read_rgb(image) if jpeg is None else jpeg


def _sweep(
    points: Points | LidarSweep,
    drive: _Drive,
    frame: int,
    position_m: tuple[float, float, float],
    where: str,
) -> LidarSweep:
    """Return a sweep of returns in the ego frame at the frame's time; a whole sweep is kept."""
    if isinstance(points, LidarSweep):
        parts = (points.origin_ego, points.dir_ego, points.range_m, points.dt_s)
        if not all(bool(part.isfinite().all()) for part in parts):
            raise InputError(f"{where}: a beam is not finite")
        if not bool(((points.intensity >= 0) & (points.intensity <= 1)).all()):
            raise InputError(f"{where}: intensity must be between 0 and 1")
        return points
    xyz = np.asarray(points.xyz_m, np.float64)
    count = len(xyz)
    columns = {
        "intensity": np.zeros(count) if points.intensity is None else np.asarray(points.intensity),
        "dt_s": np.zeros(count) if points.dt_s is None else np.asarray(points.dt_s, np.float64),
        "channel": np.full(count, -1) if points.channel is None else np.asarray(points.channel),
    }
    if xyz.shape != (count, 3) or any(values.shape != (count,) for values in columns.values()):
        shapes = {"xyz_m": xyz.shape} | {name: values.shape for name, values in columns.items()}
        raise InputError(f"{where}: points must be [N, 3] with [N] values each; they are {shapes}")
    if not np.isfinite(xyz).all() or not all(np.isfinite(values).all() for values in columns.values()):
        raise InputError(f"{where}: a point is not finite")
    if (columns["intensity"] < 0).any() or (columns["intensity"] > 1).any():
        raise InputError(f"{where}: intensity must be between 0 and 1")
    channel = columns["channel"]
    if (
        points.channel is not None
        and ((channel != np.round(channel)) | (channel < 0) | (channel > 255)).any()
    ):
        raise InputError(f"{where}: channels must be whole numbers from 0 to 255")
    if not points.compensated and points.dt_s is not None:
        xyz = _compensated(xyz, columns["dt_s"], drive, frame)
    origin = torch.tensor(position_m).expand(count, 3)
    along = torch.from_numpy(xyz).float() - origin
    range_m = along.norm(dim=-1)
    return LidarSweep(
        origin_ego=origin,
        dir_ego=along / range_m.clamp_min(1e-6)[:, None],
        range_m=range_m,
        returned=torch.ones(count, dtype=torch.bool),
        intensity=torch.from_numpy(columns["intensity"]).float(),
        dt_s=torch.from_numpy(columns["dt_s"]).float(),
        beam=torch.from_numpy(columns["channel"]).long(),
        valid=torch.ones(count, dtype=torch.bool),
    )


def _compensated(
    xyz_m: Float64[np.ndarray, "N 3"], dt_s: Float64[np.ndarray, "N"], drive: _Drive, frame: int
) -> Float64[np.ndarray, "N 3"]:
    """Move points from the ego frame at their own times to that at the frame's time."""
    times_us, which = np.unique(np.round(dt_s * 1e6), return_inverse=True)
    T = np.linalg.inv(drive.T_world_ego[frame]) @ drive.poses_at(drive.t_us[frame] + times_us)
    return np.einsum("nij,nj->ni", T[which, :3, :3], xyz_m) + T[which, :3, 3]


def _boxes(labels: Sequence[Box], where: str) -> Boxes:
    for box in labels:
        numbers = (*box.centre_m, *box.size_lwh_m, box.yaw_rad, *(box.velocity_mps or ()))
        if not np.isfinite(numbers).all() or min(box.size_lwh_m) <= 0:
            raise InputError(f"{where}: box {box.track_id} is not finite or has no size")
        if category_named(box.category) is None:
            names = ", ".join(category.name.lower() for category in Category)
            raise InputError(f"{where}: unknown category {box.category!r}; there are: {names}")
    if len({box.track_id for box in labels}) < len(labels):
        raise InputError(f"{where}: two boxes have the same track_id")
    unknown = (float("nan"), float("nan"))
    return Boxes(
        centre=torch.tensor([box.centre_m for box in labels]).reshape(-1, 3),
        size_lwh=torch.tensor([box.size_lwh_m for box in labels]).reshape(-1, 3),
        yaw=torch.tensor([float(box.yaw_rad) for box in labels]),
        velocity=torch.tensor([box.velocity_mps or unknown for box in labels]).reshape(-1, 2),
        track_id=torch.tensor([box.track_id for box in labels], dtype=torch.long),
        category=torch.tensor([category_named(box.category) for box in labels], dtype=torch.long),
        valid=torch.ones(len(labels), dtype=torch.bool),
        **unlabelled(len(labels)),
    )
