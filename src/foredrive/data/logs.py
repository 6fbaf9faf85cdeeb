"""An opened 123D log: times, ego poses and available modalities."""

import functools
import logging
import os
import resource
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from py123d.api.scene.arrow.arrow_scene_api import ArrowSceneAPI
from py123d.api.scene.arrow.modalities.sync_utils import get_sync_table
from py123d.api.utils.arrow_metadata_utils import (
    LogDirectoryMetadata,
    get_metadata_from_arrow_schema,
    resolve_metadata_class,
)
from py123d.datatypes import EgoStateSE3Metadata, LogMetadata, ModalityType

from foredrive.data.arrow_files import (
    arrow_schema,
    arrow_table,
    column_array,
    fixed_lists,
    pose_matrices,
    reading,
)
from foredrive.data.ego_path import MAX_GAP_S, interpolated_poses
from foredrive.data.log_mirror import hold
from foredrive.data.log_paths import LogPath
from foredrive.errors import InputError
from foredrive.scene import Trajectory

_NO_MODALITY = ("sync.arrow", "map.arrow")
MAX_OPEN_TABLES = 1000
"""Maximum number of Arrow files that a process keeps open. py123d's own limit is 5,000: more than many
systems allow."""
_class_of = functools.cache(resolve_metadata_class)
_log = logging.getLogger(__name__)
_may_open = min(MAX_OPEN_TABLES, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
# py123d reads it when it opens a table
os.environ.setdefault("PY123D_MAX_LRU_CACHED_TABLES", str(_may_open))


class LogScene(ArrowSceneAPI):
    """A log whose metadata are read once and are part of its pickle.

    py123d keeps the metadata of the last 1,000 logs in each process. Clips of more logs in random order would
    open all files of a log for each clip. py123d also skips files that are damaged.

    Args:
        metadata: of all files; None reads them.

    Raises:
        InputError: a file is not complete, or the log's metadata cannot be read.
    """

    __slots__ = ("_metadata",)

    def __init__(self, folder: Path, maps_dir: Path, metadata: LogDirectoryMetadata | None = None) -> None:
        super().__init__(folder, maps_root=maps_dir)
        self._metadata = _read_metadata(folder) if metadata is None else metadata

    def __reduce__(self) -> tuple[Any, ...]:
        return LogScene, (self._log_dir, self._maps_root, self._metadata)

    def _get_log_dir_metadatas(self) -> LogDirectoryMetadata:
        return self._metadata


def _read_metadata(folder: Path) -> LogDirectoryMetadata:
    schemas = {file: arrow_schema(file) for file in [folder / "sync.arrow", *sorted(folder.glob("*.arrow"))]}
    with reading(folder, "its metadata"):
        directory = LogDirectoryMetadata(
            get_metadata_from_arrow_schema(schemas[folder / "sync.arrow"], LogMetadata)
        )
        for file, schema in schemas.items():
            if file.name not in _NO_MODALITY:
                try:
                    metadata = get_metadata_from_arrow_schema(schema, _class_of(file.stem))
                except (ValueError, KeyError) as error:
                    _log.warning("%s is left out: %s", file, error)
                    continue
                directory.modality_metadatas[file.stem] = metadata
    return directory


_EGO = ModalityType.EGO_STATE_SE3.serialize()


class Log:
    """One opened log, picklable. Frames are the rows of its sync table that have an ego pose.

    A log in object storage is fetched first, and kept here while it is open.

    The ego frame is that of Foredrive: on the ground below the rear axle. The bottom face of 123D's vehicle
    box is on the ground, so the ground is half the box height below the box centre.

    Raises:
        InputError: a file is incomplete, a pose is not finite, or time runs backwards.
    """

    path: LogPath
    t_us: Int64[np.ndarray, "F"]
    """Time of each frame: that of its ego pose."""
    T_world_ego: Float64[np.ndarray, "F 4 4"]
    drive_t_us: Int64[np.ndarray, "E"]
    """Times of all ego poses, of which those of the frames are a part."""
    speed_mps: Float64[np.ndarray, "F"]
    """Ego speed: as logged, else from the previous pose. NaN at a first frame without a logged speed."""
    period_s: float
    """Median time between frames, s. 0 for a single frame."""

    def __init__(self, path: LogPath) -> None:
        self.path = path
        self._held = (hold(path.folder), hold(path.maps_dir))
        self.scene = LogScene(path.folder, path.maps_dir)
        self.metadata = self.scene.get_log_metadata()
        vehicle = self.scene.get_modality_metadata(ModalityType.EGO_STATE_SE3)
        if not isinstance(vehicle, EgoStateSE3Metadata):
            raise InputError(f"{path.folder}: a log without ego poses (no {_EGO}.arrow)")
        self.vehicle = vehicle
        self.T_imu_ego = imu_from_ego(vehicle)
        ego_t_us, T_world_ego, speed_mps = self._read_ego()
        self._iterations, ego_rows = self._read_sync(ego_t_us)
        self.t_us, self.T_world_ego = ego_t_us[ego_rows], T_world_ego[ego_rows]
        # Times in nanoseconds may share a microsecond; interpolation needs increasing ones
        distinct = np.diff(ego_t_us, prepend=ego_t_us[0] - 1) > 0
        self.drive_t_us, self._drive_T = ego_t_us[distinct], T_world_ego[distinct]
        self.period_s = float(np.median(np.diff(self.t_us))) * 1e-6 if len(self.t_us) > 1 else 0.0
        self.speed_mps = _speed(speed_mps[ego_rows], self.t_us, self.T_world_ego)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_held": ()}  # The process that opened the log holds it for its workers

    def __len__(self) -> int:
        return len(self.t_us)

    def iteration(self, frame: int) -> int:
        """Return py123d's iteration of a frame."""
        return int(self._iterations[frame])

    def rows(self, modality_key: str) -> tuple[Int64[np.ndarray, "K"], Int64[np.ndarray, "K"]]:
        """Return the frames at which the log has a modality, and the corresponding rows of its table."""
        table = get_sync_table(self.path.folder)
        if modality_key not in table.column_names:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        # The sync table has one row for each time, and for each modality its row then, or null
        row = table[modality_key].to_numpy(zero_copy_only=False).astype(np.float64)[self._iterations]
        frames = np.flatnonzero(np.isfinite(row))
        return frames, row[frames].astype(np.int64)

    def file(self, modality_key: str) -> Path:
        """Return the file of a modality."""
        return self.path.folder / f"{modality_key}.arrow"

    @property
    def ego_box(self) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Return centre and size (length, width, height) of the ego vehicle in the ego frame, m."""
        T_ego_box = np.linalg.inv(self.T_imu_ego) @ self.vehicle.center_to_imu_se3.transformation_matrix
        return T_ego_box[:3, 3], np.array([self.vehicle.length, self.vehicle.width, self.vehicle.height])

    @functools.cached_property
    def fingerprint(self) -> tuple[tuple[str, int, int], ...]:
        """Return name, size and modification time of all files except images, to detect changes."""
        files = sorted(f for f in self.path.folder.glob("*.arrow") if not f.name.startswith("camera"))
        return tuple((str(f), f.stat().st_size, f.stat().st_mtime_ns) for f in files)

    def nearest_frames(self, t_us: Float64[np.ndarray, "*n"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the frame nearest to each time, and whether it is at most half the log's period away."""
        # The frames before and after each time; a log of one frame has only that one
        after = np.searchsorted(self.t_us, t_us).clip(1, max(len(self) - 1, 1))
        before = after - 1
        after = after.clip(0, len(self) - 1)
        frame = np.where(t_us - self.t_us[before] <= self.t_us[after] - t_us, before, after)
        tolerance_us = max(0.5e6 * self.period_s, 1.0)
        return frame, np.abs(self.t_us[frame] - t_us) <= tolerance_us

    def driven_future(self, frame: int, steps: int, dt_s: float) -> Trajectory:
        """Return the ego path after `frame`, M = 1. Steps beyond the log or in a gap are not valid."""
        t_us = self.t_us[frame] + np.arange(1, steps + 1) * dt_s * 1e6
        T_world, valid = self.poses_at(t_us)
        # World to ego frame in double precision, because world coordinates may be large
        T = np.linalg.inv(self.T_world_ego[frame]) @ T_world
        keep = torch.from_numpy(valid)[None]
        return Trajectory(
            xy=torch.from_numpy(T[:, :2, 3]).float()[None] * keep[..., None],
            yaw=torch.from_numpy(np.arctan2(T[:, 1, 0], T[:, 0, 0])).float()[None] * keep,
            valid=keep,
            log_prob=torch.zeros(1),
            dt_s=dt_s,
        )

    def path_of_point(
        self, point_ego: Float[np.ndarray, "3"], t_us: Float64[np.ndarray, "N"]
    ) -> Float64[np.ndarray, "N 3"]:
        """Return world positions of a vehicle-fixed point, with constant velocity beyond the log."""
        times_us = self.drive_t_us.astype(np.float64)
        xyz = self._drive_T[:, :3, :3] @ point_ego + self._drive_T[:, :3, 3]
        if len(times_us) > 1:
            # One more point at either end, at the velocity of the first and the last step
            times_us = np.concatenate(
                [[2 * times_us[0] - times_us[1]], times_us, [2 * times_us[-1] - times_us[-2]]]
            )
            xyz = np.concatenate([[2 * xyz[0] - xyz[1]], xyz, [2 * xyz[-1] - xyz[-2]]])
        return np.stack([np.interp(t_us, times_us, xyz[:, axis]) for axis in range(3)], axis=-1)

    def poses_at(
        self, t_us: Float64[np.ndarray, "N"]
    ) -> tuple[Float64[np.ndarray, "N 4 4"], Bool[np.ndarray, "N"]]:
        """Return interpolated `T_world_ego` at any times, and whether they are valid.

        A pose is valid if the log has close poses before and after it. The vehicle stands still before and
        after the log.
        """
        valid = self.knows_pose_at(t_us)
        if len(self.drive_t_us) < 2 or len(t_us) == 0:
            return np.repeat(self._drive_T[:1], len(t_us), axis=0), valid
        return interpolated_poses(self.drive_t_us, self._drive_T, t_us), valid

    def knows_pose_at(self, t_us: Float64[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
        """Return whether the log has close poses before and after each time."""
        times_us = self.drive_t_us
        if len(times_us) < 2:
            return np.zeros(t_us.shape, dtype=bool)
        after = np.searchsorted(times_us, t_us).clip(1, len(times_us) - 1)
        return (
            (t_us >= times_us[0])
            & (t_us <= times_us[-1])
            & (times_us[after] - times_us[after - 1] <= MAX_GAP_S * 1e6)
        )

    def _read_ego(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times [E] (µs), poses [E 4 4] and logged speeds [E] (NaN if missing) of all ego states."""
        file = self.file(_EGO)
        with reading(file, "the ego states"):
            table = arrow_table(file)
            t_us = table[f"{_EGO}.timestamp_us"].to_numpy()
            pose = fixed_lists(column_array(table, f"{_EGO}.imu_se3"), 7)
            velocity = fixed_lists(column_array(table, f"{_EGO}.dynamic_state_se3"), 9)[:, :2]
        T_world_imu = pose_matrices(pose)
        bad = np.isnan(T_world_imu).any((-1, -2))
        if bad.any():
            raise InputError(f"{file}: the ego pose of row {bad.argmax()} is not a finite pose")
        if len(t_us) == 0:
            raise InputError(f"{file}: no ego poses")
        if (np.diff(t_us) < 0).any():
            raise InputError(f"{file}: time runs backwards at row {(np.diff(t_us) < 0).argmax() + 1}")
        return t_us, T_world_imu @ self.T_imu_ego, np.linalg.norm(velocity, axis=-1)

    def _read_sync(self, ego_t_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the sync rows that have an ego pose, and the rows of those poses."""
        file = self.path.folder / "sync.arrow"
        with reading(file, "the frames"):
            table = arrow_table(file)
            ego_rows = table[_EGO].to_numpy(zero_copy_only=False).astype(np.float64)
            t_us = table["sync.timestamp_us"].to_numpy()
        if (np.diff(t_us) <= 0).any():
            raise InputError(f"{file}: time runs backwards at row {(np.diff(t_us) <= 0).argmax() + 1}")
        sync_rows = np.flatnonzero(np.isfinite(ego_rows))
        ego_rows = ego_rows[sync_rows].astype(np.int64)
        if len(sync_rows) == 0:
            raise InputError(f"{file}: no frame has an ego pose")
        if (np.diff(ego_t_us[ego_rows]) <= 0).any():
            raise InputError(f"{file}: the ego poses of its frames are not in the order of time")
        return sync_rows, ego_rows


def imu_from_ego(vehicle: EgoStateSE3Metadata) -> Float64[np.ndarray, "4 4"]:
    """Return T_imu_ego of a vehicle as 123D describes it."""
    T_rear_ego = np.eye(4)
    # From the rear axle down to the bottom face of the box, which is on the ground
    T_rear_ego[2, 3] = vehicle.rear_axle_to_center_vertical - vehicle.half_height
    return vehicle.rear_axle_to_imu_se3.transformation_matrix @ T_rear_ego


def _speed(
    logged_mps: Float64[np.ndarray, "F"],
    t_us: Int64[np.ndarray, "F"],
    T_world_ego: Float64[np.ndarray, "F 4 4"],
) -> Float64[np.ndarray, "F"]:
    """Return the logged speed, else the mean speed since the previous frame, m/s.

    Later frames are not used, so that no future information leaks in.
    """
    step_m = np.linalg.norm(np.diff(T_world_ego[:, :3, 3], axis=0), axis=-1)
    past_mps = np.concatenate([[np.nan], step_m / (np.diff(t_us) * 1e-6)])
    return np.where(np.isfinite(logged_mps), logged_mps, past_mps)
