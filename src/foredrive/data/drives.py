"""A log as one clip, with its frames at the log's own rate."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.data.assemble import assemble_clip
from foredrive.data.cameras import camera_list, find_camera, pinhole_cameras
from foredrive.data.frame_store import FrameStore
from foredrive.data.lidar import read_sweep
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.geometry.se3 import log_so3
from foredrive.scene import Clip, LidarSweep
from foredrive.sensors import SpinningLidar, pandar64
from foredrive.sensors.missed_beams import with_missed_beams

_LIDARS: dict[str, Callable[[Float[Tensor, "4 4"]], SpinningLidar]] = {"pandaset": pandar64}
"""Lidars of datasets that store no missed beams: function from the pose lidar -> ego to the lidar."""


def lidar_of(dataset: str, T_ego_lidar: Float[Tensor, "4 4"]) -> SpinningLidar | None:
    """Return the lidar of a dataset, or None if it is not known."""
    make_lidar = _LIDARS.get(dataset)
    return None if make_lidar is None else make_lidar(T_ego_lidar)


def read_drive(
    path: LogPath,
    image_hw: tuple[int, int],
    cameras: tuple[str, ...] | None = None,
    cache_dir: Path | None = None,
    frames: Sequence[int] | None = None,
    derived: bool = True,
) -> Clip:
    """Read frames of a log with sweeps and boxes. Now is the first of them, so all times are >= 0.

    The clip has no command, no target and no future.

    Args:
        path: the log.
        image_hw: height and width of the resized images, px.
        cameras: camera names, the log's own or 123D's, in this order. None selects all.
        cache_dir: folder for resized images. None disables the cache.
        frames: frames of the log, in order. None reads all.
        derived: add data that the log does not store: the number of lidar points in boxes and, where the
            lidar's pattern is known, the beams that did not return (`sensors.missed_beams`).

    Raises:
        InputError: the log cannot be read, or it lacks a requested camera.
    """
    log = Log(path)
    cameras_by_name = pinhole_cameras(log)
    names = tuple(cameras_by_name) if cameras is None else cameras
    chosen = [find_camera(cameras_by_name, name) for name in names]
    for name, camera in zip(names, chosen, strict=True):
        if camera is None:
            raise InputError(
                f"{path.folder}: no camera {name!r}; there are: {camera_list(cameras_by_name.values())}"
            )
    frames = range(len(log)) if frames is None else frames
    store = FrameStore(cache_dir, image_hw, names)
    seen = [store.read(log, frame, chosen, with_points=derived) for frame in frames]
    read = _read_beams if derived else read_sweep
    sweeps = [read(log, frame) for frame in frames]
    return assemble_clip(log, frames, frames[0], seen, sweeps, log.driven_future(frames[0], 0, log.period_s))


def _read_beams(log: Log, frame: int) -> tuple[LidarSweep, bool] | None:
    """Read a sweep with the beams that did not return, if they are recorded or can be reconstructed."""
    read = read_sweep(log, frame)
    if read is None or read[1] or not len(read[0].dt_s):
        return read
    sweep = read[0]
    T_ego_lidar = torch.eye(4)
    # The lidar's pose: the origin of the beam nearest to the frame's time, without a rotation
    T_ego_lidar[:3, 3] = sweep.origin_ego[sweep.dt_s.abs().argmin()]
    lidar = lidar_of(log.metadata.dataset, T_ego_lidar)
    if lidar is None:
        return read
    # The mean motion of the vehicle over the sweep, as a twist in the ego frame
    around_us = log.t_us[frame] + 1e6 * np.array([sweep.dt_s.min(), sweep.dt_s.max()])
    first, last = torch.from_numpy(log.poses_at(around_us)[0])
    span_s = float(sweep.dt_s.max() - sweep.dt_s.min()) or 1.0
    R_ego_world = torch.from_numpy(log.T_world_ego[frame, :3, :3]).T
    velocity = R_ego_world @ (last - first)[:3, 3] / span_s
    turn = log_so3(first[:3, :3].T @ last[:3, :3]) / span_s
    twist_ego = torch.cat([velocity, turn]).float()
    return with_missed_beams(sweep, lidar, twist_ego), True
