"""Actors of a reconstructed log. They replay their tracks whatever the ego vehicle does."""

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from foredrive.driving.collisions import Box, RoadUsers
from foredrive.geometry.se3 import rotate_vectors, yaw_from_matrix
from foredrive.methods.reconstruction.tracks import ActorTracks, states_at


def users_at(tracks: ActorTracks, T_world_scene: Float64[Tensor, "4 4"], t_s: float) -> RoadUsers:
    """Return all actors at a time, one slot each. The track id of an absent actor is -1."""
    tracks = tracks.map_tensors(lambda tensor: tensor.detach().cpu())
    states = states_at(tracks, t_s)
    T_world_actor = T_world_scene @ states.T_scene_actor.double()
    half_height = 0.5 * tracks.size_lwh[:, 2:].double()
    return RoadUsers(
        track_id=torch.where(states.present, tracks.track_id, -1).numpy(),
        category=tracks.category.numpy(),
        # Foot: half the height below the box' centre, along its own z axis
        foot_m=(T_world_actor[:, :3, 3] - half_height * T_world_actor[:, :3, 2]).numpy(),
        yaw=yaw_from_matrix(T_world_actor).numpy(),
        half_lw=(0.5 * tracks.size_lwh[:, :2]).double().numpy(),
        velocity_mps=rotate_vectors(T_world_scene, states.velocity_mps.double())[:, :2].numpy(),
    )


def comes_from_behind(box: Box, users: RoadUsers) -> Bool[np.ndarray, "N"]:
    """Return which actors have their middle behind the rear of the ego box.

    If such an actor touches the box, it has driven into the ego vehicle.
    """
    forward = np.array([np.cos(box.yaw_rad), np.sin(box.yaw_rad)])
    ahead_m = (users.foot_m - box.foot_m)[:, :2] @ forward
    return np.asarray(ahead_m < -box.half_lw[0])
