"""The state of one road user, which traffic provides to the renderer and to the labels."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from foredrive.scene import Category


@dataclass(frozen=True)
class ActorState:
    """Pose, size and motion of one road user in the world frame (right-handed, z up)."""

    track_id: int
    """Number of the road user, constant over one drive."""
    category: Category
    centre_m: Float64[np.ndarray, "3"]
    """Centre of the box (not of its bottom), m."""
    yaw: float
    """Heading about world z, rad, 0 along world x, counter-clockwise."""
    pitch: float
    """Rotation about the body's y axis (left) after the yaw, rad: positive with the nose down, negative
    uphill."""
    size_lwh: Float64[np.ndarray, "3"]
    """Length along the heading, width and height, m."""
    velocity_mps: Float64[np.ndarray, "3"]
    """Velocity over ground along the world's axes, m/s."""
    style: int
    """Seed of the shape and the colour, constant over the drive."""
    parked: bool
    """True for a vehicle that is parked for the whole drive. It belongs to the place, not to the traffic."""
    braking: bool = False
    """Whether its brake lights are on."""
