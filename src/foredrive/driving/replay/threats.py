"""Safety-critical situations in reconstructed logs.

After NeuroNCAP (Ljungbergh et al., "NeuroNCAP: Photorealistic Closed-loop Safety Testing for Autonomous
Driving", 2024): a vehicle stands in the lane, comes head-on or crosses. An ego vehicle that drives on as in
the log hits it a few seconds after the start. Positions and speeds are our own choice.
"""

import enum
import math
from typing import NamedTuple

import numpy as np
import torch

from foredrive.driving.dynamics import EGO
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.route_progress import ARRIVED_M
from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3
from foredrive.methods.reconstruction.edits import DriveStraight, Offset, unused_id
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.scene import Category

AFTER_S = 4.0
"""Time after the start at which an ego vehicle that drives on as in the log is hit, s."""
THREAT_MPS = 5.0
"""Speed of the other vehicle, m/s."""
VARIED_AFTER_S, VARIED_SPEED, VARIED_BESIDE_M = (3.0, 5.0), (0.6, 1.6), 0.7
"""Ranges from which variations are drawn: time of the impact, s, share of the speed, and largest distance
beside the logged path, m.
"""
MIN_MPS = 2.0
"""If the log is slower than this at the time of impact, m/s, there is nothing to avoid."""


class Threat(enum.StrEnum):
    """The situation, by what the other vehicle does."""

    STATIONARY = "stationary"
    """A vehicle stands in the lane."""
    FRONTAL = "frontal"
    """A vehicle comes head-on in the lane."""
    SIDE = "side"
    """A vehicle crosses from the right."""


class Variation(NamedTuple):
    """A threat that is earlier or later, faster or slower, and beside the place where it is planned."""

    after_s: float = AFTER_S
    speed_mps: float = THREAT_MPS
    left_m: float = 0.0

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Variation":
        """Draw a variation."""
        return cls(
            rng.uniform(*VARIED_AFTER_S),
            THREAT_MPS * rng.uniform(*VARIED_SPEED),
            rng.uniform(-VARIED_BESIDE_M, VARIED_BESIDE_M),
        )


AS_PLANNED = Variation()


def send_threat(
    threat: Threat,
    graph: SceneGraph,
    drive: LoggedDrive,
    start_s: float,
    variation: Variation = AS_PLANNED,
) -> DriveStraight:
    """Return the edit that puts a vehicle of the scene in the way of a drive that begins at `start_s`.

    Raises:
        InputError: the scene has no car, or at the time of impact the log has ended or hardly moves.
    """
    at_s = start_s + variation.after_s
    # The log must go on beyond the impact, and move at that time
    if at_s > drive.end_s:
        raise InputError(
            f"from {start_s:g} s: the log ends at {drive.end_s:.1f} s, too early for an impact at "
            f"{at_s:.1f} s"
        )
    if (left_m := drive.way_left_m(at_s)) < ARRIVED_M:
        raise InputError(
            f"from {start_s:g} s: the log drives on for {left_m:.1f} m after an impact at {at_s:.1f} s, and "
            f"{ARRIVED_M:.0f} m are needed: the log is too short"
        )
    if drive.state_at(at_s).speed_mps < MIN_MPS:
        raise InputError(
            f"from {start_s:g} s: the vehicle of the log hardly moves at {at_s:.1f} s, so no impact would "
            "follow"
        )
    row, tracks = _most_observed_car(graph), graph.tracks
    length_m, _, height_m = tracks.size_lwh[row].tolist()
    bumper_m = EGO.axle_to_centre_m + 0.5 * EGO.length_m
    # Heading of the other vehicle, and its distance from the rear axle at the impact
    heading_rad, ahead_m = {
        Threat.STATIONARY: (0.0, bumper_m + 0.5 * length_m),
        Threat.FRONTAL: (math.pi, bumper_m + 0.5 * length_m),
        Threat.SIDE: (0.5 * math.pi, bumper_m),
    }[threat]
    T_scene_ego = (inverse_se3(drive.vehicle.T_world_scene) @ torch.from_numpy(drive.pose_at(at_s))).numpy()
    way = T_scene_ego[:3, :3] @ [math.cos(heading_rad), math.sin(heading_rad), 0.0]
    speed_mps = 0.0 if threat is Threat.STATIONARY else variation.speed_mps
    return DriveStraight(
        actor=int(tracks.track_id[row]),
        copy=unused_id(graph),
        at_m=_offset(T_scene_ego[:3, :3] @ [ahead_m, variation.left_m, 0.5 * height_m] + T_scene_ego[:3, 3]),
        at_s=at_s,
        velocity_mps=_offset(speed_mps * way),
        yaw_rad=float(np.arctan2(way[1], way[0])),
    )


def reference_mps(
    threat: Threat, drive: LoggedDrive, start_s: float, variation: Variation = AS_PLANNED
) -> float:
    """Return the impact speed of an ego vehicle that drives on as in the log, m/s."""
    speed = drive.state_at(start_s + variation.after_s).speed_mps
    return {
        Threat.STATIONARY: speed,
        Threat.FRONTAL: speed + variation.speed_mps,
        Threat.SIDE: math.hypot(speed, variation.speed_mps),
    }[threat]


def _most_observed_car(graph: SceneGraph) -> int:
    """Return the row of the car that was observed most."""
    rows = (graph.tracks.category == Category.CAR).nonzero()[:, 0].tolist()
    if not rows:
        raise InputError("the scene has no car as an actor of its own that could serve as the threat")
    return max(rows, key=graph.content.evidence)


def _offset(xyz: np.ndarray) -> Offset:
    x, y, z = xyz.tolist()
    return x, y, z
