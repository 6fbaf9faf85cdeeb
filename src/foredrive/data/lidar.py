"""Lidar sweeps of a 123D log in the ego frame, with the origin of every beam."""

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from py123d.datatypes import Lidar, LidarID, LidarMergedMetadata, LidarMetadata, ModalityType
from py123d.datatypes.custom.custom_modality import CustomModality
from torch import Tensor

import foredrive.data.formats.pandaset  # noqa: F401  (logs may refer to raw sweeps, which are pickles)
from foredrive.data.arrow_files import reading
from foredrive.data.logs import Log
from foredrive.data.modalities import LIDAR_BEAMS, unpack_beams
from foredrive.scene import LidarSweep

_MAX_SWEEP_US = 1_000_000
_MIN_RANGE_M = 1e-3


def read_sweep(log: Log, frame: int) -> tuple[LidarSweep, bool] | None:
    """Read the sweep at a frame, unbatched, and whether it includes the beams that did not return.

    The returns of all lidars are combined. If points have times, the origin of each beam is the position of
    the sensor at the beam's own time. It is given in the ego frame at the frame's time, like the
    motion-compensated points.

    Returns:
        The sweep and the flag, or None if the log has no lidar at this frame.

    Raises:
        InputError: the sweep cannot be read.
    """
    origins, misses = _recorded_beams(log, frame)
    parts = []
    for key, metadata in log.scene.get_all_modality_metadatas().items():
        if not isinstance(metadata, LidarMetadata | LidarMergedMetadata):
            continue
        with reading(log.file(key), f"the sweep at frame {frame}"):
            lidar = log.scene.get_modality_at_iteration(
                log.iteration(frame), ModalityType.LIDAR, metadata.modality_id
            )
            if isinstance(lidar, Lidar):
                parts.append(_returns(log, frame, lidar, origins))
    if not parts:
        return None
    if misses is not None:
        parts.append(misses)
    return concatenate(parts), misses is not None


def frames_with_lidar(log: Log) -> Int64[np.ndarray, "_"]:
    """Return the frames at which any lidar has a sweep."""
    frames = [
        log.rows(key)[0]
        for key, metadata in log.scene.get_all_modality_metadatas().items()
        if isinstance(metadata, LidarMetadata | LidarMergedMetadata)
    ]
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *frames]))


def lidar_mounts(log: Log) -> dict[str, Float64[np.ndarray, "4 4"]]:
    """Return `T_ego_lidar` of each lidar by its name: 123D's LIDAR_TOP first, then the highest."""
    T_ego_imu, lidars = np.linalg.inv(log.T_imu_ego), list[LidarMetadata]()
    for metadata in log.scene.get_all_modality_metadatas().values():
        if isinstance(metadata, LidarMetadata):
            lidars.append(metadata)
        elif isinstance(metadata, LidarMergedMetadata):
            lidars += metadata.lidar_metadatas.values()
    mounts = [(one, T_ego_imu @ one.lidar_to_imu_se3.transformation_matrix) for one in lidars]
    mounts.sort(key=lambda mount: (mount[0].lidar_id != LidarID.LIDAR_TOP, -float(mount[1][2, 3])))
    return {one.lidar_name: T_ego_lidar for one, T_ego_lidar in mounts}


def main_lidar_mount(log: Log) -> Float64[np.ndarray, "4 4"] | None:
    """Return `T_ego_lidar` of 123D's LIDAR_TOP, else of the highest lidar. None if the log has no lidar."""
    return next(iter(lidar_mounts(log).values()), None)


def _recorded_beams(log: Log, frame: int) -> tuple[Float[np.ndarray, "R 3"] | None, LidarSweep | None]:
    """Return the beam origins of the returns, and the misses, from logs that store them."""
    with reading(log.file(f"custom.{LIDAR_BEAMS}"), f"the beams at frame {frame}"):
        beams = log.scene.get_custom_modality_at_iteration(log.iteration(frame), LIDAR_BEAMS)
        return unpack_beams(beams.data) if isinstance(beams, CustomModality) else (None, None)


def concatenate(sweeps: list[LidarSweep]) -> LidarSweep:
    """Concatenate unbatched sweeps."""
    names = ("origin_ego", "dir_ego", "range_m", "returned", "intensity", "dt_s", "beam", "valid")
    return LidarSweep(*(torch.cat([getattr(sweep, name) for sweep in sweeps]) for name in names))


def empty_sweep() -> LidarSweep:
    """Return a sweep without beams."""
    nothing = np.zeros((0, 3), dtype=np.float32)
    return _sweep(nothing, nothing, np.zeros(0), np.zeros(0), np.zeros(0))


def _returns(log: Log, frame: int, lidar: Lidar, origins: Float[np.ndarray, "N 3"] | None) -> LidarSweep:
    T_ego_imu = np.linalg.inv(log.T_imu_ego)
    # 123D stores points in the IMU frame
    points = lidar.xyz.astype(np.float64).reshape(-1, 3) @ T_ego_imu[:3, :3].T + T_ego_imu[:3, 3]
    count = len(points)
    dt_us = np.zeros(count)
    if lidar.timestamps is not None:
        since = lidar.timestamps - log.t_us[frame]
        if (np.abs(since) <= _MAX_SWEEP_US).all():  # Some data sets use another clock for point times
            dt_us = since.astype(np.float64)
    # Recorded origins are exact; otherwise they follow from the mount and the driven path
    if origins is None:
        origins = _origins(log, frame, lidar, dt_us)
    if len(origins) != count:
        raise ValueError(f"{count} points, but {len(origins)} beams that returned")
    intensity = lidar.intensity if lidar.intensity is not None else np.zeros(count)
    beam = lidar.channel if lidar.channel is not None else np.full(count, -1)
    sweep = _sweep(points, origins, intensity / 255.0, dt_us * 1e-6, beam)
    # Points at the sensor itself, or without a position, are no returns
    real = torch.isfinite(sweep.range_m) & (sweep.range_m > _MIN_RANGE_M)
    return sweep if bool(real.all()) else sweep[real]


def _origins(log: Log, frame: int, lidar: Lidar, dt_us: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N 3"]:
    """Return the sensor position of each beam at its time, in the ego frame at the frame's time."""
    sensors = lidar.lidar_metadatas
    ids = lidar.ids if lidar.ids is not None else np.full(len(dt_us), int(next(iter(sensors))))
    T_ego_imu = np.linalg.inv(log.T_imu_ego)
    T_ego_world = np.linalg.inv(log.T_world_ego[frame])
    origin = np.zeros((len(dt_us), 3))
    for sensor_id, metadata in sensors.items():
        mounted = T_ego_imu[:3, :3] @ metadata.lidar_to_imu_se3.point_3d.array + T_ego_imu[:3, 3]
        mine = ids == int(sensor_id)
        # Without times of the points, the sensor is where it is at the frame's time
        if not dt_us[mine].any():
            origin[mine] = mounted
            continue
        world = log.path_of_point(mounted, log.t_us[frame] + dt_us[mine])
        origin[mine] = world @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
    return origin


def _sweep(
    ends: np.ndarray, origins: np.ndarray, intensity: np.ndarray, dt_s: np.ndarray, beam: np.ndarray
) -> LidarSweep:
    """Return a sweep of beams from `origins` that returned at `ends`."""
    along = ends - origins
    range_m = np.linalg.norm(along, axis=-1)
    direction = along / np.maximum(range_m, _MIN_RANGE_M)[:, None]
    return LidarSweep(
        origin_ego=_float_tensor(origins),
        dir_ego=_float_tensor(direction),
        range_m=_float_tensor(range_m),
        returned=torch.ones(len(ends), dtype=torch.bool),
        intensity=_float_tensor(intensity),
        dt_s=_float_tensor(dt_s),
        beam=torch.from_numpy(np.asarray(beam, dtype=np.int64)),
        valid=torch.ones(len(ends), dtype=torch.bool),
    )


def _float_tensor(array: np.ndarray) -> Float[Tensor, "..."]:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
