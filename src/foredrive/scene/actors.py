"""Road users in the world frame, and their boxes in the ego frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.scene.boxes import UNKNOWN, VEHICLES, Attribute, Boxes, Category, unlabelled

BOX_RANGE_M = 80.0
"""Recordings and observations have boxes up to this distance from the ego vehicle, m."""

MOVING_MPS = 0.2
"""Speed above which a road user has the attribute of a moving one, m/s."""


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
    """The brake lights are on."""


def in_box_range(actors: Sequence[ActorState], T_world_ego: Float64[np.ndarray, "4 4"]) -> list[ActorState]:
    """Return the road users within `BOX_RANGE_M` of the ego vehicle."""
    centre_m = np.array([actor.centre_m for actor in actors]).reshape(-1, 3)
    away_m = np.linalg.norm(centre_m - T_world_ego[:3, 3], axis=1)
    return [actor for actor, near in zip(actors, away_m < BOX_RANGE_M, strict=True) if near]


def boxes_in_ego_frame(actors: Sequence[ActorState], T_world_ego: Float64[np.ndarray, "4 4"]) -> Boxes:
    """Return the boxes of road users in the ego frame, unbatched."""
    # Centres and headings into the ego frame; velocities stay over ground, only their axes change
    T_ego_world = np.linalg.inv(T_world_ego)
    centre = (
        np.array([a.centre_m for a in actors]).reshape(-1, 3) @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
    )
    yaw = np.array([a.yaw for a in actors])
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=-1) @ T_ego_world[:3, :3].T
    velocity = np.array([a.velocity_mps for a in actors]).reshape(-1, 3) @ T_ego_world[:3, :3].T
    return Boxes(
        centre=torch.from_numpy(centre).float(),
        size_lwh=torch.from_numpy(np.array([a.size_lwh for a in actors]).reshape(-1, 3)).float(),
        yaw=torch.from_numpy(np.arctan2(heading[:, 1], heading[:, 0])).float(),
        velocity=torch.from_numpy(velocity[:, :2]).float(),
        track_id=torch.tensor([a.track_id for a in actors], dtype=torch.int64),
        category=torch.tensor([int(a.category) for a in actors], dtype=torch.int64),
        valid=torch.ones(len(actors), dtype=torch.bool),
        **unlabelled(len(actors))
        | {"attribute": torch.tensor([_attribute(actor) for actor in actors], dtype=torch.int64)},
    )


def _attribute(actor: ActorState) -> int:
    """Return the `Attribute` of an actor. Two-wheelers have riders unless they are parked."""
    moves = float(np.linalg.norm(actor.velocity_mps)) > MOVING_MPS
    if actor.category in (Category.BICYCLE, Category.MOTORCYCLE):
        return Attribute.CYCLE_WITHOUT_RIDER if actor.parked else Attribute.CYCLE_WITH_RIDER
    if actor.category is Category.PEDESTRIAN:
        return Attribute.PEDESTRIAN_MOVING if moves else Attribute.PEDESTRIAN_STANDING
    if actor.category in VEHICLES:
        at_rest = Attribute.VEHICLE_PARKED if actor.parked else Attribute.VEHICLE_STOPPED
        return Attribute.VEHICLE_MOVING if moves else at_rest
    return UNKNOWN
