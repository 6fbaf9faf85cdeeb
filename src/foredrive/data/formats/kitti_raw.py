"""A 123D parser for KITTI's raw recordings (Geiger et al., "Vision meets robotics", 2013), without boxes.

A log is one folder DATE_drive_NUMBER_sync ("synced and rectified") with image_02, image_03, velodyne_points
and oxts. The calibration files are in its parent, the folder of the date.

The lidar's points are in its own frame at the time of each. It turns clockwise, seen from above, begins at
the rear, and looks ahead when the cameras are exposed. So a point's azimuth gives its time, and the path of
the vehicle puts it where it was at the time of the frame. The points of a file go round row by row from the
front, top row first: where their azimuth begins anew, the next channel begins.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64
from py123d.datatypes import (
    Camera,
    CameraID,
    EgoStateSE3,
    Lidar,
    LidarID,
    LidarMetadata,
    LogMetadata,
    PinholeCameraMetadata,
    PinholeIntrinsics,
    Timestamp,
)
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.geometry import PoseSE3
from py123d.parser.base_dataset_parser import BaseLogParser, ModalitiesSync
from py123d.parser.kitti360.utils.kitti360_constants import KITTI360_EGO_STATE_SE3_METADATA
from scipy.spatial.transform import Rotation, Slerp

from foredrive.data.ego_path import MAX_GAP_S, in_holes
from foredrive.data.formats.guard import PartReader
from foredrive.data.formats.point_files import KITTI, IntensityScale, read_points
from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.images import is_image, read_rgb
from foredrive.data.notices import note
from foredrive.errors import InputError

_CAMERAS = {"image_02": ("02", CameraID.PCAM_STEREO_L), "image_03": ("03", CameraID.PCAM_STEREO_R)}
_EARTH_M = 6_378_137.0
_PERIOD_US = 103_600
"""Time of one turn of the lidar, where no file has it."""
_CHANNELS = 64
_LIDAR = "velodyne_points"
_PROPORTION = 0.01
"""Share by which the height of a shrunk image may differ, beside one pixel."""


class KittiRawParser(BaseLogParser):
    """Parser of one drive. The vehicle is that of KITTI-360, which is the same.

    Args:
        folder: the drive's folder; calib_*.txt are in its parent.
        split: 123D split, e.g. kitti-raw_train.
    """

    def __init__(self, folder: Path, split: str) -> None:
        self._folder, self._split = Path(folder), split

    def get_log_metadata(self) -> LogMetadata:
        """Return the log's metadata. Its name is that of the folder."""
        return LogMetadata("kitti-raw", self._split, self._folder.name, location=None)

    def iter_modalities_sync(self) -> Iterator[ModalitiesSync]:
        """Yield the frames that have a sweep or an image: ego pose, lidar and the colour cameras.

        The time of a frame is that of the sweep, or of an image where the lidar has none.

        Raises:
            InputError: the drive is not synced and rectified, or all files of a stream are damaged.
        """
        _check_synced(self._folder)
        times_us = {
            name: _times_us(self._folder / name / "timestamps.txt")
            for name in (_LIDAR, *_CAMERAS)
            if name == _LIDAR or (self._folder / name / "data").is_dir()
        }
        # Begin and end of each turn of the lidar, and the path that its points are moved along
        spans_us = self._spans_us(times_us[_LIDAR])
        path = _Path.read(self._folder / "oxts")
        _ = self._calibration  # read once here: a missing one is a fault of the log, not of single files
        readers = {name: PartReader(name, "files") for name in (_LIDAR, *_CAMERAS)}
        scale = IntensityScale(_LIDAR)
        for frame, files in self._files().items():
            # The first stream that has a time for the frame
            t_us = next((t for stream in times_us.values() if (t := _time_of(stream, frame))), 0)
            if not t_us:
                note(self._folder.name, "frames without a time, left out", f"{frame:010d}")
                continue
            if path.misses(t_us):
                text = f"frames without OXTS' records within {MAX_GAP_S:g} s around them, left out"
                note(self._folder.name, text, f"{frame:010d}")
                continue
            modalities: list[BaseModality] = []
            for name, file in files.items():
                if name != _LIDAR:
                    load = functools.partial(self._camera, name, file, _time_of(times_us[name], frame), path)
                else:
                    load = functools.partial(self._lidar, file, t_us, spans_us[frame], path, scale)
                loaded = readers[name](file.name, load)
                modalities += [] if loaded is None else [loaded]
            if _LIDAR not in files:
                note(_LIDAR, "missing sweeps", f"{frame:010d}")
            now = Timestamp.from_us(t_us)
            pose = _pose(path.at(np.array([t_us]))[0])
            ego = EgoStateSE3.from_imu(pose, KITTI360_EGO_STATE_SE3_METADATA, now)
            yield ModalitiesSync(now, [ego, *modalities])
        for reader in readers.values():
            reader.check()

    def _files(self) -> dict[int, dict[str, Path]]:
        """Return the files of each frame by stream."""
        files: dict[int, dict[str, Path]] = {}
        for name in (_LIDAR, *_CAMERAS):
            for file in sorted((self._folder / name / "data").glob("[0-9]*")):
                if is_image(file) or (name == _LIDAR and file.suffix == ".bin"):
                    files.setdefault(int(file.stem), {})[name] = file
        return dict(sorted(files.items()))

    def _lidar(
        self,
        file: Path,
        t_us: int,
        span_us: Int64[np.ndarray, "2"],
        path: "_Path",
        scale: IntensityScale,
    ) -> Lidar:
        points = read_points(file, KITTI)
        xyz = points[:, :3].astype(np.float64)
        azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
        share = 0.5 * (1 - azimuth / np.pi)  # 0 at the rear, ½ ahead, clockwise
        # The time of a point follows from its azimuth, as the lidar turns evenly
        at_us = (span_us[0] + share * (span_us[1] - span_us[0])).astype(np.int64)
        T_imu_velo = self._calibration.T_imu_velo
        features = {
            "intensity": np.round(scale(points[:, 3]) * 255).astype(np.uint8),
            "timestamps": at_us,
        }
        channel = _channels(azimuth)
        if channel is not None:
            features["channel"] = channel
        return Lidar(
            timestamp=Timestamp.from_us(int(span_us[0])),
            timestamp_end=Timestamp.from_us(int(span_us[1])),
            metadata=LidarMetadata("velodyne", LidarID.LIDAR_TOP, _pose(T_imu_velo)),
            # Each point goes to the IMU's frame at its own time, then to that at the time of the frame
            point_cloud_3d=path.moved(_transformed(T_imu_velo, xyz), at_us, t_us).astype(np.float32),
            point_cloud_features=features,
        )

    def _camera(self, name: str, file: Path, t_us: int, path: "_Path") -> Camera:
        """Return the camera with an image.

        Raises:
            InputError: the image cannot be read, or has no time.
        """
        if not t_us:
            raise InputError(f"{name}/timestamps.txt has no time of it")
        number, camera_id = _CAMERAS[name]
        image = read_rgb(file)
        K, T_imu_cam = self._calibration.camera(number, (image.shape[1], image.shape[0]))
        metadata = PinholeCameraMetadata(
            camera_name=name,
            camera_id=camera_id,
            intrinsics=PinholeIntrinsics.from_camera_matrix(K),
            distortion=None,
            width=image.shape[1],
            height=image.shape[0],
            camera_to_imu_se3=_pose(T_imu_cam),
            is_undistorted=True,
        )
        # The camera is where the vehicle is when the image is taken, not at the time of the frame
        T_world_cam = path.at(np.array([t_us]))[0] @ T_imu_cam
        return Camera(metadata, image, _pose(T_world_cam), Timestamp.from_us(t_us))

    @cached_property
    def _calibration(self) -> "_Calibration":
        return _Calibration.read(self._folder.parent)

    def _spans_us(self, times_us: Int64[np.ndarray, "N"]) -> Int64[np.ndarray, "N 2"]:
        """Return begin and end of each turn of the lidar."""
        files = [self._folder / _LIDAR / f"timestamps_{end}.txt" for end in ("start", "end")]
        if all(file.is_file() for file in files):
            return np.stack([_times_us(file) for file in files], axis=-1)
        # Without the files of begin and end, the sweep lies about its time
        return times_us[:, None] + np.array([-_PERIOD_US // 2, _PERIOD_US // 2])


@dataclass(frozen=True)
class _Path:
    """Poses of the IMU over time, from OXTS' records: T_world_imu with the origin at the first one."""

    t_us: Int64[np.ndarray, "N"]
    position_m: Float64[np.ndarray, "N 3"]
    turn: Slerp

    @classmethod
    def read(cls, folder: Path) -> "_Path":
        """Read latitude, longitude, altitude, roll, pitch and yaw of all records.

        Positions are in the Mercator projection at the first latitude, as in KITTI's development kit.
        """
        t_us = _times_us(folder / "timestamps.txt")
        read, records = PartReader("oxts", "records"), dict[int, list[float]]()
        for file in sorted((folder / "data").glob("[0-9]*.txt")):
            record = read(file.name, functools.partial(_record, file, _time_of(t_us, int(file.stem))))
            if record is not None:
                records[int(file.stem)] = record
        read.check()
        rows, frames = np.array(list(records.values())), np.array(list(records))
        latitude, longitude = np.radians(rows[:, 0]), np.radians(rows[:, 1])
        # Mercator projection, scaled to metres at the first latitude
        scale_m = np.cos(latitude[0]) * _EARTH_M
        north_m = scale_m * np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
        # East, north, up
        position_m = np.stack([scale_m * longitude, north_m, rows[:, 2]], axis=-1)
        times_us = t_us[frames]
        if len(rows) == 1:  # a vehicle that stands; a Slerp needs two
            rows, times_us = np.repeat(rows, 2, axis=0), times_us + np.array([0, 1])
            position_m = np.repeat(position_m, 2, axis=0)
        # Yaw, pitch, roll as intrinsic rotations about z, y, x
        turn = Rotation.from_euler("ZYX", rows[:, [5, 4, 3]])
        return cls(times_us, position_m - position_m[0], Slerp(times_us, turn))

    def misses(self, t_us: int) -> bool:
        """Return whether a time is in a hole of the path, or more than a period before or after it."""
        if t_us < self.t_us[0] - _PERIOD_US or t_us > self.t_us[-1] + _PERIOD_US:
            return True
        T = self.at(self.t_us)
        return bool(in_holes(self.t_us, T, np.array([t_us]))[0])

    def at(self, t_us: Int64[np.ndarray, "M"]) -> Float64[np.ndarray, "M 4 4"]:
        """Return T_world_imu at times: linear in between, standing still before and after."""
        # Before the first and after the last record the vehicle stands still
        t_us = t_us.clip(self.t_us[0], self.t_us[-1])
        T = np.tile(np.eye(4), (len(t_us), 1, 1))
        T[:, :3, :3] = self.turn(t_us).as_matrix()
        for axis in range(3):
            T[:, axis, 3] = np.interp(t_us, self.t_us, self.position_m[:, axis])
        return T

    def moved(
        self, points: Float64[np.ndarray, "P 3"], at_us: Int64[np.ndarray, "P"], t_us: int
    ) -> Float64[np.ndarray, "P 3"]:
        """Return points, each in the IMU's frame at its own time, in the frame at one time."""
        T = self.at(at_us)
        # Every point has a pose of its own
        world = np.einsum("pij,pj->pi", T[:, :3, :3], points) + T[:, :3, 3]
        return _transformed(np.linalg.inv(self.at(np.array([t_us]))[0]), world)


@dataclass(frozen=True)
class _Calibration:
    """The calibration of a day. "rect" is the rectified frame of camera 0."""

    T_imu_velo: Float64[np.ndarray, "4 4"]
    T_imu_rect: Float64[np.ndarray, "4 4"]
    projections: dict[str, Float64[np.ndarray, "3 4"]]
    sizes: dict[str, Float64[np.ndarray, "2"]]
    """Widths and heights for which the projections hold."""

    @classmethod
    def read(cls, folder: Path) -> "_Calibration":
        """Read calib_imu_to_velo.txt, calib_velo_to_cam.txt and calib_cam_to_cam.txt."""
        imu, velo, cameras = (
            _numbers(folder / f"calib_{name}.txt") for name in ("imu_to_velo", "velo_to_cam", "cam_to_cam")
        )
        T_imu_velo = np.linalg.inv(_rigid(imu["R"], imu["T"]))
        # Velodyne to camera 0, then to the rectified frame
        T_rect_velo = _rigid(cameras["R_rect_00"], np.zeros(3)) @ _rigid(velo["R"], velo["T"])
        numbers = [number for number, _ in _CAMERAS.values()]
        return cls(
            T_imu_velo,
            T_imu_velo @ np.linalg.inv(T_rect_velo),
            {number: cameras[f"P_rect_{number}"].reshape(3, 4) for number in numbers},
            {number: cameras[f"S_rect_{number}"] for number in numbers},
        )

    def camera(
        self, number: str, size_wh: tuple[int, int]
    ) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "4 4"]]:
        """Return K for images of a size, which may be shrunk, and T_imu_cam.

        Raises:
            InputError: images have other proportions, so they are cut or not rectified.
        """
        P = self.projections[number]
        width, height = self.sizes[number].tolist()
        shrunk = abs(size_wh[0] * height / width - size_wh[1])
        if shrunk > max(1.0, _PROPORTION * size_wh[1]):
            raise InputError(
                f"an image of {size_wh[0]} x {size_wh[1]} px is not one of {width:g} x {height:g} px that "
                "was shrunk: it is cut, where is not known, or not rectified"
            )
        T_cam_rect = np.eye(4)
        # Offset of the camera from camera 0: P = K [I | t]
        T_cam_rect[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
        # Shrunk images scale the rows of K
        K = np.diag([*(size_wh / self.sizes[number]), 1.0]) @ P[:, :3]
        return K, self.T_imu_rect @ np.linalg.inv(T_cam_rect)


def _check_synced(folder: Path) -> None:
    """Check that a drive is one of those that KITTI calls "synced and rectified".

    Raises:
        InputError: it is an "extract": images with distortion, sweeps in text, records of OXTS at 100 Hz.
    """
    sweeps = {file.suffix for file in (folder / _LIDAR / "data").glob("[0-9]*")}
    if folder.name.endswith("_extract") or (".txt" in sweeps and ".bin" not in sweeps):
        message = "unsynced and unrectified recordings are not read; use the …_sync of the drive"
        raise InputError(f"{folder}: {message}")


def _channels(azimuth: Float64[np.ndarray, "P"]) -> np.ndarray | None:
    """Return the row of each point, or None if there are more rows than the lidar has channels."""
    # A jump of the azimuth back to the front begins a new row
    row = np.cumsum(np.diff(azimuth % (2 * np.pi), prepend=0.0) < -np.pi)
    return row.astype(np.uint8) if not len(row) or row[-1] < _CHANNELS else None


def _numbers(file: Path) -> dict[str, Float64[np.ndarray, "K"]]:
    """Return the entries of a calibration file that are numbers."""
    numbers = {}
    for line in file.read_text(encoding="utf-8-sig").splitlines():
        name, _, words = line.partition(":")
        if name.startswith(("R", "T", "P_rect", "S_rect")):
            numbers[name] = np.array([float(word) for word in words.split()])
    return numbers


def _record(file: Path, t_us: int) -> list[float]:
    """Return latitude, longitude, altitude, roll, pitch and yaw of OXTS' record of one time.

    Raises:
        InputError: the record lacks one of them, or has no time.
    """
    values = [float(word) for word in file.read_text(encoding="utf-8-sig").split()[:6]]
    if len(values) < 6 or not np.isfinite(values).all():
        raise InputError("not six finite numbers")
    if not t_us:
        raise InputError("oxts/timestamps.txt has no time of it")
    return values


def _time_of(times_us: Int64[np.ndarray, "N"], frame: int) -> int:
    """Return the time of a frame, or 0 where it has none."""
    return int(times_us[frame]) if frame < len(times_us) else 0


def _times_us(file: Path) -> Int64[np.ndarray, "N"]:
    """Return the times of a file with one in each line. The lines of lost frames are empty; they give 0."""
    times = []
    for line in file.read_text(encoding="utf-8-sig").rstrip().split("\n"):
        if not line.strip():
            times.append(0)
        else:
            whole, _, part = line.strip().partition(".")
            seconds = datetime.fromisoformat(whole).replace(tzinfo=UTC).timestamp()
            # Whole µs, without rounding by floating point
            times.append(round(seconds) * 1_000_000 + int(part.ljust(6, "0")[:6]))
    return np.array(times, dtype=np.int64)


def _rigid(R: Float64[np.ndarray, "9"], t: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "4 4"]:
    """Return a pose with its rotation orthonormalised, because the files have only seven digits."""
    T = np.eye(4)
    U, _, V = np.linalg.svd(R.reshape(3, 3))
    if np.linalg.det(U @ V) < 0:
        raise InputError("a calibration file has a rotation that mirrors")
    T[:3, :3], T[:3, 3] = U @ V, t
    return T


def _transformed(T: Float64[np.ndarray, "4 4"], points: Float64[np.ndarray, "P 3"]) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def _pose(T: Float64[np.ndarray, "4 4"]) -> PoseSE3:
    return PoseSE3.from_transformation_matrix(T)


def find_kitti_raw(source: Path) -> Iterator[RawLog]:
    """Yield the raw logs of a folder: of its root, of one log, or of one or two levels above them."""
    for folder in folders_with(source, "velodyne_points/data"):
        yield RawLog(folder, KittiRawParser(folder, "kitti-raw_train"))
