"""Conversions between CARLA's frames and Foredrive's: pure functions.

CARLA is left-handed (x forward, y to the right, z up) with angles in degrees: yaw positive to the right,
pitch positive nose up, roll positive right side down. Foredrive is right-handed (docs/conventions.md).
Mirroring y converts one world into the other. A rotation R becomes M R M with M = diag(1, -1, 1).

The origin of a vehicle is the middle of its box on the ground in CARLA, and the middle of its rear axle in
Foredrive.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from foredrive.driving.dynamics import EGO

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_BODY_FROM_OPTICAL = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Rotation from a camera's optical axes (x right, y down, z forward) to its body axes (x forward, y left,
z up)."""


class CarlaPose(NamedTuple):
    """The content of a `carla.Transform`: m and degrees, left-handed."""

    x: float
    y: float
    z: float
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0


def mirrored(xyz: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
    """Convert points or vectors between the two worlds, in either direction."""
    return xyz * [1.0, -1.0, 1.0]


def xyz_of(vector: Any) -> Float64[np.ndarray, "3"]:
    """Convert a `carla.Location` or `carla.Vector3D` to our axes."""
    return np.array([vector.x, -vector.y, vector.z])


def matrix_of(transform: Any) -> Float64[np.ndarray, "4 4"]:
    """Convert a `carla.Transform` to a matrix.

    It maps an actor's or sensor's axes to the world's, all right-handed.
    """
    return MIRROR @ np.array(transform.get_matrix()) @ MIRROR


def pose_of(T: Float64[np.ndarray, "4 4"]) -> CarlaPose:
    """Convert a rigid motion between right-handed axes to CARLA's form. The inverse of `matrix_of`."""
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
    """Return `T_actor_ego`: our ego frame in the right-handed axes of CARLA's actor.

    Args:
        box_centre_x_m: x of the box's middle in the actor's axes, m (`bounding_box.location.x`).
    """
    T = np.eye(4)
    T[0, 3] = box_centre_x_m - EGO.axle_to_centre_m
    return T


def camera_pose(T_ego_cam: Float64[np.ndarray, "4 4"], T_actor_ego: Float64[np.ndarray, "4 4"]) -> CarlaPose:
    """Return the mounting pose of a camera on CARLA's actor."""
    return pose_of(T_actor_ego @ T_ego_cam @ _BODY_FROM_OPTICAL.T)


def yaw_of_compass(compass_rad: float) -> float:
    """Convert an IMU's compass to our heading, rad.

    The compass is 0 to the north, which is CARLA's -y, and turns clockwise seen from above.
    """
    return math.remainder(0.5 * math.pi - compass_rad, 2 * math.pi)
