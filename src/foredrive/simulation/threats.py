"""Safety-critical moments in rebuilt logs, and what a drive through one is worth.

After NeuroNCAP (Ljungbergh et al., "NeuroNCAP: Photorealistic Closed-loop Safety Testing for Autonomous
Driving", 2024): somebody stands in the way, comes head-on or crosses, so that who goes on as the log did runs
into him a few seconds after the start. Where and how fast they come is ours.
"""

import enum
import math

import numpy as np
import torch

from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3
from foredrive.rendering.edits import Offset, Send
from foredrive.rendering.scene_graph import SceneGraph
from foredrive.scene import Category
from foredrive.simulation.dynamics import EGO
from foredrive.simulation.logged_drive import LoggedDrive
from foredrive.simulation.route_progress import ARRIVED_M

AFTER_S = 4.0
"""So long after the start who goes on as the log did is hit."""
THREAT_MPS = 5.0
"""How fast others come."""
LEAST_MPS = 2.0
"""A log that is slower when it would be hit has nothing to avoid."""
BEST, AFTER_COLLISION = 5.0, 4.0


class Threat(enum.StrEnum):
    """What is in the way."""

    STATIONARY = "stationary"
    """A vehicle that stands in the lane."""
    FRONTAL = "frontal"
    """One that comes head-on in the lane."""
    SIDE = "side"
    """One that crosses from the right."""


def send_threat(threat: Threat, graph: SceneGraph, drive: LoggedDrive, start_s: float) -> Send:
    """The edit that puts a vehicle of a scene in the way of a drive that begins at a time.

    Raises:
        InputError: there is no car to take, or the log is over by then, or hardly moves.
    """
    at_s = start_s + AFTER_S
    if at_s > drive.end_s or drive.way_left_m(at_s) < ARRIVED_M:
        raise InputError(f"the log ends at {drive.end_s:.1f} s, too early to meet anybody at {at_s:.1f} s")
    if drive.state_at(at_s).speed_mps < LEAST_MPS:
        raise InputError(f"the log hardly moves at {at_s:.1f} s: nobody would be met")
    row, tracks = _most_seen_car(graph), graph.tracks
    length_m, _, height_m = tracks.size_lwh[row].tolist()
    bumper_m = EGO.axle_to_centre_m + 0.5 * EGO.length_m
    heading_rad, ahead_m = {
        Threat.STATIONARY: (0.0, bumper_m + 0.5 * length_m),
        Threat.FRONTAL: (math.pi, bumper_m + 0.5 * length_m),
        Threat.SIDE: (0.5 * math.pi, bumper_m),
    }[threat]
    T_scene_ego = (inverse_se3(drive.vehicle.T_world_scene) @ torch.from_numpy(drive.pose_at(at_s))).numpy()
    way = T_scene_ego[:3, :3] @ [math.cos(heading_rad), math.sin(heading_rad), 0.0]
    speed_mps = 0.0 if threat is Threat.STATIONARY else THREAT_MPS
    return Send(
        actor=int(tracks.track_id[row]),
        copy=threat_id(graph),
        at_m=_offset(T_scene_ego[:3, :3] @ [ahead_m, 0.0, 0.5 * height_m] + T_scene_ego[:3, 3]),
        at_s=at_s,
        velocity_mps=_offset(speed_mps * way),
        yaw_rad=float(np.arctan2(way[1], way[0])),
    )


def threat_id(graph: SceneGraph) -> int:
    """An id that no actor of a scene has."""
    return int(graph.tracks.track_id.max()) + 1 if len(graph.tracks) else 1


def reference_mps(threat: Threat, drive: LoggedDrive, start_s: float) -> float:
    """At what speed who goes on as the log did is hit."""
    speed = drive.state_at(start_s + AFTER_S).speed_mps
    return {
        Threat.STATIONARY: speed,
        Threat.FRONTAL: speed + THREAT_MPS,
        Threat.SIDE: math.hypot(speed, THREAT_MPS),
    }[threat]


def threat_score(impact_mps: float | None, reference: float) -> float:
    """NeuroNCAP's score: 5 without a collision (None), else 4 · max(0, 1 - v_impact / v_reference)."""
    return BEST if impact_mps is None else AFTER_COLLISION * max(0.0, 1.0 - impact_mps / reference)


def _most_seen_car(graph: SceneGraph) -> int:
    """The row of the car with most Gaussians."""
    rows = (graph.tracks.category == Category.CAR).nonzero()[:, 0].tolist()
    if not rows:
        raise InputError("there is no car in the scene that could be put in the way")
    return max(rows, key=lambda row: int((graph.actor == row).sum()))


def _offset(xyz: np.ndarray) -> Offset:
    x, y, z = xyz.tolist()
    return x, y, z
