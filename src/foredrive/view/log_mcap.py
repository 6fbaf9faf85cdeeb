"""An MCAP file of a log and of a run's predictions on it, in Foxglove's schemas."""

from collections.abc import Callable
from pathlib import Path

from mcap_protobuf.writer import Writer

from foredrive.data import LogPath
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.integrations import foxglove
from foredrive.runs import Run
from foredrive.scene import VoxelSpec
from foredrive.view import palette
from foredrive.view.log_contents import FrameContent, log_contents


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
    with atomic_path(file) as temporary, temporary.open("wb") as opened:
        mcap = _Mcap(Writer(opened))
        for content in log_contents(path, run):
            _write_sensors(mcap, content)
            _write_labels(mcap, content)
            if run is not None:
                _write_prediction(mcap, content, run.recipe.clips.voxels)
            tick()
        mcap.writer.add_metadata(
            "foredrive", {"log": path.name, "run": "" if run is None else run.folder.name}
        )
        mcap.writer.finish()
    return sorted(mcap.topics)


class _Mcap:
    """A writer that knows its topics."""

    def __init__(self, writer: Writer) -> None:
        self.writer, self.topics = writer, set[str]()

    def write(self, topic: str, t_us: int, message: object) -> None:
        """Write a message with the time of its frame."""
        self.topics.add(topic)
        self.writer.write_message(topic, message, log_time=t_us * 1000, publish_time=t_us * 1000)


def _write_sensors(mcap: _Mcap, content: FrameContent) -> None:
    t_us = content.t_us
    moved = foxglove.transform_message(t_us, foxglove.WORLD, foxglove.EGO, content.T_world_ego)
    mcap.write("/tf", t_us, moved)
    # Image and calibration carry the time of exposure; the message is logged at its frame's time
    for camera in content.cameras:
        own = foxglove.camera_frame(camera.name)
        mounted = foxglove.transform_message(t_us, foxglove.EGO, own, camera.T_ego_mount)
        mcap.write("/tf", t_us, mounted)
        calibration = foxglove.calibration_message(
            camera.exposed_us, camera.name, camera.K, camera.dist, camera.size_hw
        )
        mcap.write(f"/{own}/calibration", t_us, calibration)
        image = foxglove.image_message(camera.exposed_us, camera.name, camera.encoded)
        mcap.write(f"/{own}/image", t_us, image)
    if content.sweep is not None:
        mcap.write("/lidar", t_us, foxglove.cloud_message(t_us, content.sweep))


def _write_labels(mcap: _Mcap, content: FrameContent) -> None:
    t_us = content.t_us
    if content.boxes is not None:
        mcap.write("/boxes", t_us, foxglove.boxes_message(t_us, content.boxes, content.box_colours()))
    mcap.write("/driven", t_us, foxglove.path_message(t_us, content.driven))
    if content.map_lines:
        lines = foxglove.lines_message(t_us, list(content.map_lines), f"map at {t_us}")
        mcap.write("/map", t_us, lines)


def _write_prediction(mcap: _Mcap, content: FrameContent, spec: VoxelSpec) -> None:
    if content.plan is None or content.occupied is None:
        return
    t_us = content.t_us
    mcap.write("/plan", t_us, foxglove.path_message(t_us, content.plan))
    colour = palette.rgb255(palette.PLAN)
    mcap.write("/occupancy", t_us, foxglove.voxels_message(t_us, content.occupied, spec, colour))
