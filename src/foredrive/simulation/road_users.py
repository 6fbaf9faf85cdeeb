"""Road users as oriented boxes, and the test whether they touch the ego vehicle."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.scene import Category
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic

LEVEL_M = 2.0
"""Road users further apart than this in height, m, pass over or under each other."""


class RoadUsers(NamedTuple):
    """N slots for all road users except the ego vehicle, world frame."""

    track_id: Int[np.ndarray, "N"]
    """-1 in empty slots."""
    category: Int[np.ndarray, "N"]
    foot_m: Float64[np.ndarray, "N 3"]
    """Middle of the box on the ground, m."""
    yaw: Float64[np.ndarray, "N"]
    half_lw: Float64[np.ndarray, "N 2"]
    velocity_mps: Float64[np.ndarray, "N 2"]

    def towards(self, later: "RoadUsers", part: float) -> "RoadUsers":
        """Interpolate linearly towards a later time. A user that is absent then stays where it is."""
        same = self.track_id == later.track_id
        moved = np.where(same, part, 0.0)
        turned = (later.yaw - self.yaw + np.pi) % (2 * np.pi) - np.pi
        return self._replace(
            foot_m=self.foot_m + moved[:, None] * (later.foot_m - self.foot_m),
            yaw=self.yaw + moved * turned,
            velocity_mps=self.velocity_mps + moved[:, None] * (later.velocity_mps - self.velocity_mps),
        )

    def without(self, track_ids: Int[np.ndarray, "k"]) -> "RoadUsers":
        """Return the road users with some of them marked as absent."""
        return self._replace(track_id=np.where(np.isin(self.track_id, track_ids), -1, self.track_id))


class Box(NamedTuple):
    """An upright box on the ground."""

    foot_m: Float64[np.ndarray, "3"]
    """Middle of the box on the ground, m."""
    yaw_rad: float
    half_lw: Float64[np.ndarray, "2"]


def road_users(traffic: Traffic, state: TrafficState) -> RoadUsers:
    """Return all road users except vehicle 0."""
    v, p, scripted, poses = state.vehicles, state.people, state.scripted_actors, traffic.poses(state)
    forward = poses.forward[1:, :2]
    foot = poses.centre_m[1:] - 0.5 * v.size_lwh[1:, 2:] * [0.0, 0.0, 1.0]
    way = np.array([actor.speed_mps * actor.ahead for actor in scripted]).reshape(-1, 2)
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


def touched(box: Box, users: RoadUsers) -> Bool[np.ndarray, "N"]:
    """Return which road users overlap a box.

    Two boxes overlap if no axis of either separates them (Gottschalk et al. 1996, in the plane).
    """
    offset = users.foot_m - box.foot_m
    near = (users.track_id >= 0) & (np.abs(offset[:, 2]) < LEVEL_M)
    reach = np.hypot(*box.half_lw) + np.hypot(users.half_lw[:, 0], users.half_lw[:, 1])
    near &= np.abs(offset[:, :2]).max(axis=1) < reach
    hit = np.zeros(len(near), dtype=np.bool_)
    for i in np.flatnonzero(near).tolist():
        mine, theirs = _axes(box.yaw_rad), _axes(float(users.yaw[i]))
        between = np.abs(mine @ theirs.T)
        apart = np.abs(mine @ offset[i, :2]) > box.half_lw + between @ users.half_lw[i]
        apart |= np.abs(theirs @ offset[i, :2]) > users.half_lw[i] + between.T @ box.half_lw
        hit[i] = not apart.any()
    return hit


def _axes(yaw_rad: float) -> Float64[np.ndarray, "2 2"]:
    """Return the forward and the left unit vector, in rows."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[cos, sin], [-sin, cos]])
