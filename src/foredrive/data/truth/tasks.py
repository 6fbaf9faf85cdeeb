"""Find the tasks that a log can judge, each with the reason why or why not."""

from dataclasses import dataclass

import numpy as np

from foredrive.data.boxes import Tracks, read_tracks
from foredrive.data.cameras import pinhole_cameras
from foredrive.data.logs import Log
from foredrive.data.maps import map_file
from foredrive.data.modalities import BOX_ATTRIBUTE, BOX_VISIBILITY, FULL_OCCUPANCY
from foredrive.data.truth.semantic_labels import ABSENT_IN_TOWNS
from foredrive.scene.boxes import UNKNOWN, VEHICLES

MOTION_S = 6.0
"""Horizon of motion forecasting."""
PLAN_S = 3.0
"""Horizon of planning."""


@dataclass(frozen=True)
class TaskSupport:
    """Whether a log has the truth of a task."""

    task: str
    judged: bool
    reason: str

    @property
    def line(self) -> str:
        """Return the support as one line of text."""
        return f"{self.task}: {'yes' if self.judged else 'no'}, {self.reason}"


def tasks_of(log: Log) -> tuple[TaskSupport, ...]:
    """Return what a log can judge of detection, tracking, map, motion, occupancy and planning.

    Raises:
        InputError: the boxes cannot be read.
    """
    tracks = read_tracks(log)
    # The longest track and the drive decide about horizons
    lasting_s = 0.0 if tracks is None else _longest_s(tracks)
    driven_s = float(log.t_us[-1] - log.t_us[0]) * 1e-6
    return (
        _detection(log, tracks),
        _tracking(tracks, lasting_s),
        TaskSupport("map", map_file(log) is not None, "it has a map" if map_file(log) else "it has no map"),
        _motion(tracks, lasting_s),
        _occupancy(log, tracks),
        TaskSupport("planning", driven_s >= PLAN_S, f"the drive lasts {driven_s:.1f} s"),
    )


def _detection(log: Log, tracks: Tracks | None) -> TaskSupport:
    if tracks is None or not tracks.is_object.any():
        return TaskSupport("detection", False, "it has no boxes")
    lacks = []
    if not log.file(f"custom.{BOX_ATTRIBUTE}").is_file():
        lacks.append("attributes (no attribute error)")
    if not log.file(f"custom.{BOX_VISIBILITY}").is_file():
        lacks.append("visibility")
    if (tracks.num_points == UNKNOWN).any():
        lacks.append("numbers of lidar points (counted from its sweeps)")
    if not pinhole_cameras(log):
        lacks.append("images")
    return TaskSupport("detection", True, "boxes" + (f" without {', '.join(lacks)}" if lacks else ""))


def _tracking(tracks: Tracks | None, lasting_s: float) -> TaskSupport:
    if tracks is None or not tracks.is_object.any():
        return TaskSupport("tracking", False, "it has no boxes")
    if lasting_s == 0.0:
        return TaskSupport("tracking", False, "no track has two boxes")
    return TaskSupport("tracking", True, f"tracks of up to {lasting_s:.1f} s")


def _motion(tracks: Tracks | None, lasting_s: float) -> TaskSupport:
    if tracks is None or lasting_s == 0.0:
        return TaskSupport("motion", False, "it has no tracks")
    cut = "" if lasting_s >= MOTION_S else f", so no future of {MOTION_S:g} s is whole"
    return TaskSupport("motion", True, f"tracks of up to {lasting_s:.1f} s{cut}")


def _occupancy(log: Log, tracks: Tracks | None) -> TaskSupport:
    vehicles = tracks is not None and bool(np.isin(tracks.category, [int(kind) for kind in VEHICLES]).any())
    if log.file(f"custom.{FULL_OCCUPANCY}").is_file():
        never = ", ".join(ABSENT_IN_TOWNS)
        return TaskSupport("occupancy", True, f"exact voxels with classes, but never {never}")
    if vehicles:
        return TaskSupport("occupancy", True, "vehicles from above (IoU, VPQ), but no voxels with classes")
    return TaskSupport("occupancy", False, "neither voxels with classes nor boxes of vehicles")


def _longest_s(tracks: Tracks) -> float:
    """Return the longest time between the first and the last box of a track."""
    if not len(tracks.track_id):
        return 0.0
    _, number = np.unique(tracks.track_id[tracks.is_object], return_inverse=True)
    if not len(number):
        return 0.0
    t_us = tracks.t_us[tracks.is_object]
    # First and last time of each track
    first, last = np.full(number.max() + 1, np.inf), np.full(number.max() + 1, -np.inf)
    np.minimum.at(first, number, t_us)
    np.maximum.at(last, number, t_us)
    return float((last - first).max()) * 1e-6
