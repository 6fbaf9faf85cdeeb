"""Score results files under the published protocols of a task, into a folder of results."""

import time
from collections.abc import Callable
from pathlib import Path

from rich.progress import Progress

from foredrive.engine.provenance import collect_provenance, peak_rss_gib
from foredrive.engine.summary import Figures, write_summary
from foredrive.errors import InputError
from foredrive.runs.score.run import SUMMARY
from foredrive.tasks.detection.figures import score_objects
from foredrive.tasks.detection.kitti_boxes import score_kitti_boxes
from foredrive.tasks.maps.files import read_maps
from foredrive.tasks.maps.score import score_map_files, tell_if_map_is_turned
from foredrive.tasks.motion.score import score_motion_results
from foredrive.tasks.objects.reading import read_objects
from foredrive.tasks.occupancy.files import find_voxels
from foredrive.tasks.occupancy.log_results import holds_logs, score_against_logs
from foredrive.tasks.occupancy.score import score_voxels
from foredrive.tasks.tracking.kitti_tracks import score_kitti_tracks
from foredrive.tasks.tracking.score import score_tracks


def score_occupancy(results: Path, truth: Path, poses: Path | None) -> Figures:
    """Return the figures of folders of semantic voxels, see `tasks.occupancy`. The truth may be of logs."""
    if holds_logs(truth):
        _check_no_poses("occupancy and a truth of logs", poses)
        with Progress(transient=True) as progress:
            bar = progress.add_task(results.name, total=None)
            return score_against_logs(results, truth, on_frame=lambda: progress.advance(bar))
    files = find_voxels(results, truth, poses)
    with Progress(transient=True) as progress:
        bar = progress.add_task(results.name, total=len(files.truth))
        return score_voxels(files, on_frame=lambda: progress.advance(bar))


def score_map(results: Path, truth: Path, poses: Path | None) -> Figures:
    """Return the figures of files of vector maps, see `tasks.maps`."""
    _check_no_poses("map", poses)
    files = read_maps(results, truth)
    tell_if_map_is_turned(files, results)
    return score_map_files(files)


def score_motion(results: Path, truth: Path, poses: Path | None) -> Figures:
    """Return the figures of files of forecast agents, see `tasks.motion`."""
    _check_no_poses("motion", poses)
    return score_motion_results(results, truth)


def score_detection(results: Path, truth: Path, poses: Path | None) -> Figures:
    """Return the figures of detections, see `tasks.tracking`."""
    _check_no_poses("detection", poses)
    if results.is_dir():
        return score_kitti_boxes(results, truth)
    return score_objects(*read_objects(results, truth, "detection"))


def score_tracking(results: Path, truth: Path, poses: Path | None) -> Figures:
    """Return the figures of tracks, see `tasks.tracking`."""
    _check_no_poses("tracking", poses)
    if results.is_dir():
        return score_kitti_tracks(results, truth)
    return score_tracks(*read_objects(results, truth, "tracking"))


def _check_no_poses(task: str, poses: Path | None) -> None:
    if poses is not None:
        raise InputError(f"--poses does not go with --task {task}")


TASKS: dict[str, Callable[[Path, Path, Path | None], Figures]] = {
    "detection": score_detection,
    "map": score_map,
    "motion": score_motion,
    "occupancy": score_occupancy,
    "tracking": score_tracking,
}
"""Functions of results, truth and poses, by the name of their task."""


def score_task(task: str, results: Path, truth: Path, out: Path, poses: Path | None = None) -> Figures:
    """Score results under all protocols of a task; write `out/summary.json`.

    Args:
        task: one of `TASKS`.
        results, truth: files or folders as the task's data sets define them.
        poses: where the sensors were, for tasks that need it.

    Returns:
        The written summary.

    Raises:
        InputError: a file cannot be read, or results and truth are not of the same frames.
    """
    started = time.perf_counter()
    figures = TASKS[task](results, truth, poses)
    figures |= {"task": task, "wall_s": time.perf_counter() - started}
    figures |= {"peak_rss_gib": peak_rss_gib(), **collect_provenance()}
    write_summary(out / SUMMARY, figures)
    return figures
