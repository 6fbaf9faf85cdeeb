"""CARLA's frames and ours: pure functions.

CARLA is left-handed (x forward, y to the right, z up) with angles in degrees, yaw positive to the right,
pitch positive nose up, roll positive right side down. Ours are right-handed (docs/conventions.md). Mirroring
y turns one world into the other; a rotation R becomes M R M with M = diag(1, -1, 1).

A vehicle's origin is the middle of its box on the ground in CARLA, the middle of its rear axle in ours.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from foredrive.simulation.dynamics import EGO

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_BODY_FROM_OPTICAL = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""A camera's optical axes (x right, y down, z forward) in its body's (x forward, y left, z up)."""


class CarlaPose(NamedTuple):
    """What a `carla.Transform` holds: m and degrees, left-handed."""

    x: float
    y: float
    z: float
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0


def mirrored(xyz: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
    """Points or vectors from one world to the other, either way."""
    return xyz * [1.0, -1.0, 1.0]


def xyz_of(vector: Any) -> Float64[np.ndarray, "3"]:
    """A `carla.Location` or `carla.Vector3D` in our axes."""
    return np.array([vector.x, -vector.y, vector.z])


def matrix_of(transform: Any) -> Float64[np.ndarray, "4 4"]:
    """A `carla.Transform`, from an actor's or sensor's axes to the world's, between our right-handed axes."""
    return MIRROR @ np.array(transform.get_matrix()) @ MIRROR


def pose_of(T: Float64[np.ndarray, "4 4"]) -> CarlaPose:
    """The other way round: a rigid motion between right-handed axes as CARLA writes it."""
    x, y, z = T[:3, 3]
    forward, left_z, up_z = T[:3, 0], T[2, 1], T[2, 2]
    return CarlaPose(
        x=float(x),
        y=float(-y),
        z=float(z),
        roll_deg=math.degrees(math.atan2(left_z, up_z)),
        pitch_deg=math.degrees(math.asin(min(max(float(forward[2]), -1.0), 1.0))),
        yaw_deg=math.degrees(-math.atan2(forward[1], forward[0])),
    )


def ego_in_actor(box_centre_x_m: float = 0.0) -> Float64[np.ndarray, "4 4"]:
    """`T_actor_ego`: our ego frame in the right-handed axes of CARLA's actor.

    Args:
        box_centre_x_m: how far before the actor's origin its box has its middle (`bounding_box.location.x`).
    """
    T = np.eye(4)
    T[0, 3] = box_centre_x_m - EGO.axle_to_centre_m
    return T


def camera_pose(T_ego_cam: Float64[np.ndarray, "4 4"], T_actor_ego: Float64[np.ndarray, "4 4"]) -> CarlaPose:
    """Where a camera is mounted on CARLA's actor."""
    return pose_of(T_actor_ego @ T_ego_cam @ _BODY_FROM_OPTICAL.T)


def yaw_of_compass(compass_rad: float) -> float:
    """Our heading of an IMU's compass: 0 is north, CARLA's -y, from there clockwise seen from above."""
    return math.remainder(0.5 * math.pi - compass_rad, 2 * math.pi)
