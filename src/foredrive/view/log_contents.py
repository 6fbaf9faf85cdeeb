"""All that is drawn of a log, frame by frame, for the files of other viewers."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from foredrive.data import LogPath
from foredrive.data.cameras import camera_mount, encoded_image, pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.maps import read_map_patch
from foredrive.runs import Run
from foredrive.scene import Boxes, LidarSweep, MapKind, Trajectory
from foredrive.view import palette
from foredrive.view.log_frames import LogFrames

MAP_STEP_M = 50.0
"""Distance that is driven between two patches of the map."""
DRIVEN_S, DRIVEN_STEPS = 0.5, 8
CAMERA_WIDTH_PX = 64
"""Width of the images that are read for boxes and plans; those in a file are the log's own."""
RGB = tuple[int, int, int]


@dataclass(frozen=True)
class CameraContent:
    """The image of one camera, as it is stored, and its calibration."""

    name: str
    encoded: bytes
    """JPEG or PNG."""
    exposed_us: int
    """Time of exposure in the time of the log."""
    K: Float[Tensor, "3 3"]
    dist: Float[Tensor, "5"]
    size_hw: tuple[int, int]
    T_ego_cam: Float[Tensor, "4 4"]
    """From the camera at its exposure to the vehicle at the frame's time."""
    T_ego_mount: Float64[Tensor, "4 4"]
    """The mount of the camera."""


@dataclass(frozen=True)
class FrameContent:
    """All that is drawn of one frame. What the log does not have is None."""

    t_us: int
    T_world_ego: Float64[Tensor, "4 4"]
    cameras: tuple[CameraContent, ...]
    sweep: LidarSweep | None
    boxes: Boxes | None
    """The valid ones, in the ego frame."""
    driven: Trajectory
    map_lines: tuple[tuple[Float64[np.ndarray, "_ 3"], RGB], ...]
    """Polylines in the world frame with their colours. Without any, the lines of earlier frames hold."""
    plan: Trajectory | None = None
    occupied: Bool[Tensor, "Z Y X"] | None = None
    """Predicted occupancy of now, on the voxels of the run."""

    def box_colours(self) -> list[RGB]:
        """Return the colours of the boxes by their categories."""
        kinds = [] if self.boxes is None else self.boxes.category.tolist()
        return [palette.rgb255(palette.box_colour(kind)) for kind in kinds]


def log_contents(path: LogPath, run: Run | None = None) -> Iterator[FrameContent]:
    """Yield the frames of a log in the order of time, with the predictions of a run if one is given.

    Raises:
        InputError: the log cannot be read, or it lacks the cameras of the run.
    """
    log, frames = Log(path), LogFrames(path, CAMERA_WIDTH_PX, run)
    map_at: Float64[np.ndarray, 3] | None = None
    for index, t_us in enumerate(frames.now_us):
        frame, clip = int(np.searchsorted(log.t_us, t_us)), frames.clip(index)
        here, lines = log.T_world_ego[frame, :3, 3], list[tuple[np.ndarray, RGB]]()
        # A map patch is drawn only where the vehicle has left the middle of the last one
        if map_at is None or np.linalg.norm(here - map_at) > MAP_STEP_M:
            map_at, lines = here, _map_lines(log, frame)
        sweep, boxes, prediction = read_sweep(log, frame), clip.boxes[clip.now], frames.prediction(index)
        yield FrameContent(
            int(log.t_us[frame]),
            torch.from_numpy(log.T_world_ego[frame]),
            tuple(_cameras(log, frame)),
            None if sweep is None else sweep[0],
            boxes[boxes.valid] if bool(clip.boxes_valid[clip.now]) else None,
            log.driven_future(frame, DRIVEN_STEPS, DRIVEN_S),
            tuple(lines),
            None if prediction is None else prediction.plan,
            None if prediction is None else prediction.occupancy_logit[0] > 0,
        )


def _cameras(log: Log, frame: int) -> Iterator[CameraContent]:
    for name, camera in pinhole_cameras(log).items():
        encoded = encoded_image(log, frame, camera)
        if encoded is None:
            continue
        size_hw = (camera.height, camera.width)
        read = read_camera(log, frame, camera, size_hw, with_image=False)
        exposed_us = int(log.t_us[frame]) + round(read.exposed_dt_s * 1e6)
        mount = torch.from_numpy(camera_mount(log, camera))
        yield CameraContent(name, encoded, exposed_us, read.K, read.dist, size_hw, read.T_ego_cam, mount)


def _map_lines(log: Log, frame: int) -> list[tuple[np.ndarray, RGB]]:
    patch, T = read_map_patch(log, frame), log.T_world_ego[frame]
    return [
        (
            vertices[valid].double().numpy() @ T[:3, :3].T + T[:3, 3],
            palette.rgb255(palette.MAP_COLOURS[MapKind(kind)]),
        )
        for vertices, valid, kind in zip(patch.vertices, patch.valid, patch.kind.tolist(), strict=True)
    ]
