"""Road users as oriented boxes, and their collisions with the ego vehicle."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.driving.dynamics import EGO, Vehicle
from foredrive.scene import BicycleState, Category, Event

LEVEL_M = 2.0
"""Road users further apart than this in height, m, pass over or under each other."""
BUMPER_M, FLANK_M = 0.8, 0.3
"""An object inside the first `BUMPER_M` of the front, except in the outer `FLANK_M` on each side, stops
the vehicle. Contact elsewhere only scrapes."""
SAME_S, SAME_M = 5.0, 3.0
"""A contact counts as a new collision if the last contact with the same road user is more than `SAME_S`
ago, or if the last static contact is more than `SAME_M` away (CARLA's CollisionTest)."""


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
        # Shortest turn between the headings
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


@dataclass(frozen=True)
class Contacts:
    """Contacts so far in a drive."""

    users: tuple[tuple[int, float], ...] = ()
    """Track id and time of the last contact, s, of each road user hit recently."""
    standing_xy: tuple[float, float] | None = None
    """Position of the last counted contact with a static object, m, world frame."""


@dataclass(frozen=True)
class EgoContact:
    """What counts as a collision of the ego vehicle with a road user."""

    vehicle: Vehicle = EGO
    """Its body is the box that collides."""
    categories: frozenset[Category] | None = None
    """Road users that count; None: all."""
    struck_counts: bool = False
    """Whether an impact counts if the road user comes from behind the ego vehicle."""

    def counted(self, users: RoadUsers) -> RoadUsers:
        """Return the road users that count; the others are marked as absent."""
        if self.categories is None:
            return users
        counts = np.isin(users.category, [int(category) for category in self.categories])
        return users._replace(track_id=np.where(counts, users.track_id, -1))


def collide(
    box: Box, ego: BicycleState, users: RoadUsers, met: tuple[tuple[int, float], ...], t_s: float
) -> tuple[list[Event], tuple[tuple[int, float], ...]]:
    """Return the new collisions of the ego vehicle's box with road users, and the updated contact times.

    Args:
        met: contact times so far, as `Contacts.users`.
    """
    # Impact speed is the norm of the velocity difference
    velocity = ego.speed_mps * np.array([np.cos(ego.yaw_rad), np.sin(ego.yaw_rad)])
    contacts, events = dict(met), []
    for i in np.flatnonzero(touched(box, users)).tolist():
        track, category = int(users.track_id[i]), Category(int(users.category[i]))
        # The same road user counts again only after some seconds without contact
        if t_s - contacts.get(track, -np.inf) > SAME_S:
            kind = "pedestrian" if category is Category.PEDESTRIAN else "vehicle"
            impact_mps = float(np.hypot(*(velocity - users.velocity_mps[i])))
            where = (float(users.foot_m[i, 0]), float(users.foot_m[i, 1]))
            text = f"{category.name.lower()} {track} at {impact_mps:.1f} m/s"
            events.append(Event(f"collision_{kind}", t_s, where, text, category.name.lower(), impact_mps))
        contacts[track] = t_s
    return events, tuple((track, at_s) for track, at_s in contacts.items() if t_s - at_s <= SAME_S)


def blocked(box: Box, users: RoadUsers) -> bool:
    """Return whether a vehicle stands directly in front of the bumper."""
    # A box at the front bumper, narrower than the vehicle: its sides only scrape
    forward = np.array([np.cos(box.yaw_rad), np.sin(box.yaw_rad), 0.0])
    half = np.array([0.5 * BUMPER_M, box.half_lw[1] - FLANK_M])
    bumper = Box(box.foot_m + (box.half_lw[0] - half[0]) * forward, box.yaw_rad, half)
    return bool((touched(bumper, users) & (users.category != Category.PEDESTRIAN)).any())


def ego_box(T_world_ego: Float64[np.ndarray, "4 4"], ego: BicycleState, vehicle: Vehicle = EGO) -> Box:
    """Return the box of the ego vehicle."""
    foot = T_world_ego[:3, 3] + vehicle.axle_to_centre_m * T_world_ego[:3, 0]
    return Box(foot, ego.yaw_rad, 0.5 * np.array([vehicle.length_m, vehicle.width_m]))


def touched(box: Box, users: RoadUsers) -> Bool[np.ndarray, "N"]:
    """Return which road users overlap a box.

    Two boxes overlap if no axis of either separates them (Gottschalk et al. 1996, in the plane).
    """
    offset = users.foot_m - box.foot_m
    near = (users.track_id >= 0) & (np.abs(offset[:, 2]) < LEVEL_M)
    # Circumscribed circles first, then the exact test
    reach = np.hypot(*box.half_lw) + np.hypot(users.half_lw[:, 0], users.half_lw[:, 1])
    near &= np.abs(offset[:, :2]).max(axis=1) < reach
    hit = np.zeros(len(near), dtype=np.bool_)
    for i in np.flatnonzero(near).tolist():
        mine, theirs = _axes(box.yaw_rad), _axes(float(users.yaw[i]))
        # |cos| of the angles between the axes of both boxes
        between = np.abs(mine @ theirs.T)
        # Separating axes: the centre distance exceeds both half extents along one of the four axes
        apart = np.abs(mine @ offset[i, :2]) > box.half_lw + between @ users.half_lw[i]
        apart |= np.abs(theirs @ offset[i, :2]) > users.half_lw[i] + between.T @ box.half_lw
        hit[i] = not apart.any()
    return hit


def _axes(yaw_rad: float) -> Float64[np.ndarray, "2 2"]:
    """Return the forward and the left unit vector, in rows."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[cos, sin], [-sin, cos]])
