"""A check of a log: its content, and how its sensors fit together."""

import dataclasses

import numpy as np
import torch

from foredrive.data import LogPath
from foredrive.data.drives import read_drive
from foredrive.data.lidar import frames_with_lidar
from foredrive.data.log_check import Finding, LogCheck, check_log
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.methods.reconstruction.sweep_edges import spread_along_path
from foredrive.methods.reconstruction.tracks import read_tracks
from foredrive.methods.reconstruction.views import camera_views, ego_twists, sweep_views
from foredrive.runs.reconstruction.calibration_check import calibration_findings

CALIBRATION_HW = (270, 480)


def check_with_calibration(path: LogPath) -> LogCheck:
    """Check a log, and whether its lidar points fit its images if it has both.

    Raises:
        InputError: the log cannot be opened, or has no ego poses.
    """
    check = check_log(path)
    return dataclasses.replace(check, findings=[*check.findings, *_calibration(path)])


def _calibration(path: LogPath) -> list[Finding]:
    log = Log(path)
    swept = frames_with_lidar(log)
    if not len(swept):
        return []
    # A few frames spread along the path are enough to compare images with sweeps
    frames = swept[spread_along_path(torch.from_numpy(log.T_world_ego[swept, :3, 3]))].tolist()
    try:
        drive = read_drive(path, CALIBRATION_HW, frames=frames, derived=False)
    except InputError as error:
        return [Finding("problem", "calibration", f"not checked: {error}")]
    t_s = torch.from_numpy((log.t_us - log.t_us[0]).astype(np.float32) * 1e-6)
    # Motion is computed from all poses of the log, then taken at the chosen frames
    twists = ego_twists(t_s, torch.from_numpy(log.T_world_ego))[frames]
    T_world_scene = drive.T_world_ego[0]
    views = [view for camera in camera_views(drive, T_world_scene, twists) for view in camera]
    tracks, sweeps = read_tracks(drive, T_world_scene), sweep_views(drive, T_world_scene)
    return [
        Finding("problem" if finding.large else "note", "calibration", finding.text)
        for finding in calibration_findings(drive.rig.names, views, sweeps, tracks)
    ]
