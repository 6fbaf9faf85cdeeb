"""Road users of a town's traffic as oriented boxes."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Int

from foredrive.driving.collisions import RoadUsers
from foredrive.scene import Category
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic


def road_users(traffic: Traffic, state: TrafficState) -> RoadUsers:
    """Return all road users except vehicle 0."""
    # Rows from 1 on: vehicle 0 is the ego vehicle
    v, p, scripted, poses = state.vehicles, state.people, state.scripted_actors, traffic.poses(state)
    forward = poses.forward[1:, :2]
    # Poses give box centres; the foot is half the height below
    foot = poses.centre_m[1:] - 0.5 * v.size_lwh[1:, 2:] * [0.0, 0.0, 1.0]
    way = np.array([actor.speed_mps * actor.ahead for actor in scripted]).reshape(-1, 2)
    # Slots that are not active have the number -1
    track_id = [np.where(v.active, v.track_id, -1)[1:], np.where(p.active, p.track_id, -1)]
    on_foot = np.full(len(p.active), int(Category.PEDESTRIAN))
    size_lwh = np.array([actor.size_lwh for actor in scripted]).reshape(-1, 3)
    return RoadUsers(
        track_id=np.concatenate([*track_id, _numbers(actor.track_id for actor in scripted)]),
        category=np.concatenate(
            [v.category[1:], on_foot, _numbers(int(actor.category) for actor in scripted)]
        ),
        foot_m=np.concatenate([foot, p.xyz, np.array([actor.xyz for actor in scripted]).reshape(-1, 3)]),
        yaw=np.concatenate([poses.yaw[1:], p.yaw, [actor.yaw_rad for actor in scripted]]),
        half_lw=0.5 * np.concatenate([v.size_lwh[1:, :2], p.size_lwh[:, :2], size_lwh[:, :2]]),
        velocity_mps=np.concatenate([v.speed_mps[1:, None] * forward, p.velocity_mps[:, :2], way]),
    )


def _numbers(values: Iterable[int]) -> Int[np.ndarray, "n"]:
    return np.fromiter(values, dtype=np.int64)
