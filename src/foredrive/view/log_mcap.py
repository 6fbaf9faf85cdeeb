"""An MCAP file of a log and of a run's predictions on it, in Foxglove's schemas.

Rerun 0.41 draws images, sweeps and poses of it, but no boxes and no map, which are scene updates of Foxglove.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from mcap_protobuf.writer import Writer

from foredrive.data import LogPath
from foredrive.data.cameras import camera_mount, encoded_image, pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.maps import read_map_patch
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.integrations import foxglove
from foredrive.runs import Run
from foredrive.scene import MapKind
from foredrive.view import palette
from foredrive.view.log_frames import LogFrames

MAP_STEP_M = 50.0
"""Distance that is driven between two patches of the map."""
DRIVEN_S, DRIVEN_STEPS = 0.5, 8
CAMERA_WIDTH_PX = 64
"""Width of the images that are read for boxes and plans; those in the file are the log's own."""


def write_log_mcap(
    path: LogPath, file: Path, run: Run | None = None, tick: Callable[[], None] = lambda: None
) -> list[str]:
    """Write images, calibrations, sweeps, boxes, map, poses and driven path of a log, and a run's plans.

    With a run, the plan and the predicted occupancy of now are in the file too. Times are the log's; an image
    has that of its exposure.

    Args:
        path: the log.
        file: where the MCAP file goes.
        run: a trained run whose predictions are added.
        tick: called after each frame.

    Returns:
        The topics in the file.

    Raises:
        InputError: the log cannot be read, or it lacks the cameras of the run.
    """
    if file.suffix != ".mcap":
        raise InputError(f"{file}: the name must end in .mcap")
    log, frames = Log(path), LogFrames(path, CAMERA_WIDTH_PX, run)
    with atomic_path(file) as temporary, temporary.open("wb") as opened:
        mcap = _Mcap(Writer(opened))
        for index, t_us in enumerate(frames.now_us):
            frame = int(np.searchsorted(log.t_us, t_us))
            _write_sensors(mcap, log, frame)
            _write_labels(mcap, log, frames, index, frame)
            if run is not None:
                _write_prediction(mcap, frames, run, index, t_us)
            tick()
        mcap.writer.add_metadata(
            "foredrive", {"log": path.name, "run": "" if run is None else run.folder.name}
        )
        mcap.writer.finish()
    return sorted(mcap.topics)


class _Mcap:
    """A writer that knows its topics, and where the map was written last."""

    def __init__(self, writer: Writer) -> None:
        self.writer, self.topics = writer, set[str]()
        self.map_at: np.ndarray | None = None

    def write(self, topic: str, t_us: int, message: object) -> None:
        """Write a message with the time of its frame."""
        self.topics.add(topic)
        self.writer.write_message(topic, message, log_time=t_us * 1000, publish_time=t_us * 1000)


def _write_sensors(mcap: _Mcap, log: Log, frame: int) -> None:
    t_us, T = int(log.t_us[frame]), torch.from_numpy(log.T_world_ego[frame])
    mcap.write("/tf", t_us, foxglove.transform_message(t_us, foxglove.WORLD, foxglove.EGO, T))
    for name, camera in pinhole_cameras(log).items():
        encoded = encoded_image(log, frame, camera)
        if encoded is None:
            continue
        size_hw = (camera.height, camera.width)
        read = read_camera(log, frame, camera, size_hw, with_image=False)
        # Image and calibration carry the time of exposure; the message is logged at its frame's time
        exposed_us = t_us + round(read.exposed_dt_s * 1e6)
        mounted = torch.from_numpy(camera_mount(log, camera))
        own = foxglove.camera_frame(name)
        mcap.write("/tf", t_us, foxglove.transform_message(t_us, foxglove.EGO, own, mounted))
        calibration = foxglove.calibration_message(exposed_us, name, read.K, read.dist, size_hw)
        mcap.write(f"/{own}/calibration", t_us, calibration)
        mcap.write(f"/{own}/image", t_us, foxglove.image_message(exposed_us, name, encoded))
    sweep = read_sweep(log, frame)
    if sweep is not None:
        mcap.write("/lidar", t_us, foxglove.cloud_message(t_us, sweep[0]))


def _write_labels(mcap: _Mcap, log: Log, frames: LogFrames, index: int, frame: int) -> None:
    t_us, clip = int(log.t_us[frame]), frames.clip(index)
    if bool(clip.boxes_valid[clip.now]):
        boxes = clip.boxes[clip.now]
        kinds = boxes.category[boxes.valid].tolist()
        colours = [palette.rgb255(palette.box_colour(kind)) for kind in kinds]
        mcap.write("/boxes", t_us, foxglove.boxes_message(t_us, boxes, colours))
    driven = log.driven_future(frame, DRIVEN_STEPS, DRIVEN_S)
    mcap.write("/driven", t_us, foxglove.path_message(t_us, driven))
    here = log.T_world_ego[frame, :3, 3]
    # A map patch is written only where the vehicle has left the middle of the last one
    if mcap.map_at is None or np.linalg.norm(here - mcap.map_at) > MAP_STEP_M:
        mcap.map_at = here
        _write_map(mcap, log, frame)


def _write_map(mcap: _Mcap, log: Log, frame: int) -> None:
    patch, T = read_map_patch(log, frame), log.T_world_ego[frame]
    lines = []
    for vertices, valid, kind in zip(patch.vertices, patch.valid, patch.kind.tolist(), strict=True):
        points = vertices[valid].double().numpy() @ T[:3, :3].T + T[:3, 3]
        lines.append((points, palette.rgb255(palette.MAP_COLOURS[MapKind(kind)])))
    if lines:
        t_us = int(log.t_us[frame])
        mcap.write("/map", t_us, foxglove.lines_message(t_us, lines, f"map at {frame}"))


def _write_prediction(mcap: _Mcap, frames: LogFrames, run: Run, index: int, t_us: int) -> None:
    prediction = frames.prediction(index)
    if prediction is None:
        return
    mcap.write("/plan", t_us, foxglove.path_message(t_us, prediction.plan))
    occupied, spec = prediction.occupancy_logit[0] > 0, run.recipe.clips.voxels
    colour = palette.rgb255(palette.PLAN)
    mcap.write("/occupancy", t_us, foxglove.voxels_message(t_us, occupied, spec, colour))
