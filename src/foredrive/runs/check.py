"""A check of a log: its content, and how its sensors fit together."""

import dataclasses

from foredrive.data import LogPath
from foredrive.data.drives import read_drive
from foredrive.data.log_check import Finding, LogCheck, check_log
from foredrive.errors import InputError
from foredrive.rendering.tracks import read_tracks
from foredrive.rendering.views import camera_views, sweep_views
from foredrive.runs.rebuild.calibration_check import calibration_findings

CALIBRATION_HW = (270, 480)
MAX_FRAMES = 150
"""Frames whose images and sweeps are compared, from the middle of the log."""


def check_with_calibration(path: LogPath) -> LogCheck:
    """Check a log, and whether lidar points fit the images where both are there.

    Raises:
        InputError: the log cannot be opened, or has no ego poses.
    """
    found = check_log(path)
    return dataclasses.replace(found, findings=[*found.findings, *_calibration(path)])


def _calibration(path: LogPath) -> list[Finding]:
    try:
        drive = read_drive(path, CALIBRATION_HW, max_frames=MAX_FRAMES)
    except InputError as error:
        return [Finding("problem", "calibration", f"not checked: {error}")]
    T_world_scene = drive.T_world_ego[0]
    views = [view for camera in camera_views(drive, T_world_scene) for view in camera]
    tracks, sweeps = read_tracks(drive, T_world_scene), sweep_views(drive, T_world_scene)
    told = calibration_findings(drive.rig.names, views, sweeps, tracks)
    return [Finding("problem", "calibration", text) for text in told]
