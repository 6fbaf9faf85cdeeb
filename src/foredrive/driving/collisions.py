"""Collisions of the ego vehicle: with road users by their boxes, with static objects by the town's meshes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from foredrive.scene import BicycleState, Category, Event
from foredrive.simulation.dynamics import EGO, Vehicle
from foredrive.simulation.road_users import Box, RoadUsers, touched
from foredrive.towns.place.materials import Surface
from foredrive.towns.world import World

PASSABLE = (Surface.ROAD, Surface.SIDEWALK, Surface.TERRAIN, Surface.HIDDEN)
SOLID = np.array([surface not in PASSABLE for surface in Surface])
RAY_HEIGHTS_M = (0.35, 0.8)
RAY_SPACING_M = 0.12
"""Lateral distance between rays, m: posts are not much thinner."""
BUMPER_M, FLANK_M = 0.8, 0.3
"""An object inside the first `BUMPER_M` of the front, except in the outer `FLANK_M` on each side, stops
the vehicle. Contact elsewhere only scrapes."""
SAME_S, SAME_M = 5.0, 3.0
"""A contact counts as a new collision if the last contact with the same road user is more than `SAME_S`
ago, or if the last static contact is more than `SAME_M` away (CARLA's CollisionTest)."""


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


class CollisionSense:
    """Detects the collisions of the ego vehicle in one world."""

    def __init__(self, world: World) -> None:
        self._world = world
        half_width, length = 0.5 * EGO.width_m, EGO.length_m
        y = np.linspace(-half_width, half_width, int(np.ceil(EGO.width_m / RAY_SPACING_M)) + 1)
        start = [[EGO.axle_to_centre_m + 0.5 * length, left, up] for up in RAY_HEIGHTS_M for left in y]
        self._start_ego: Float64[np.ndarray, "R 3"] = np.array(start)
        self._in_front = np.abs(self._start_ego[:, 1]) < half_width - FLANK_M

    def check(
        self,
        T_world_ego: Float64[np.ndarray, "4 4"],
        ego: BicycleState,
        users: RoadUsers,
        contacts: Contacts,
        t_s: float,
    ) -> tuple[list[Event], Contacts, bool]:
        """Return the new collisions, the updated contacts, and whether an obstacle stops the vehicle."""
        box = ego_box(T_world_ego, ego)
        events, recent = collide(box, ego, users, contacts.users, t_s)
        stands_in_front, struck = self._standing(T_world_ego)
        standing_xy = contacts.standing_xy
        if struck is not None:
            xy, surface = struck
            if standing_xy is None or np.hypot(*np.subtract(xy, standing_xy)) > SAME_M:
                what = "parked car" if surface is Surface.VEHICLE else surface.name.lower()
                text = f"{what} at {ego.speed_mps:.1f} m/s"
                events.append(Event("collision_static", t_s, xy, text, what, ego.speed_mps))
                standing_xy = xy
        stopped = stands_in_front or blocked(box, users)
        return events, Contacts(recent, standing_xy), stopped

    def _standing(
        self, T_world_ego: Float64[np.ndarray, "4 4"]
    ) -> tuple[bool, tuple[tuple[float, float], Surface] | None]:
        """Return whether the bumper meets a static object, and the foremost hit inside the vehicle's outline.

        A hit is its position (m, world frame) and its surface. Rays go from the bumper to the rear.
        """
        R, origin = T_world_ego[:3, :3], T_world_ego[:3, 3]
        start = self._start_ego @ R.T + origin
        way = np.broadcast_to(-EGO.length_m * R[:, 0], start.shape)
        rays: list[Float32[np.ndarray, "R 3"]] = [np.ascontiguousarray(x, np.float32) for x in (start, way)]
        part, surface = self._world.struck(*rays)
        inside = (part <= 1.0) & SOLID[surface]
        if not inside.any():
            return False, None
        at_front = inside & self._in_front & (part * EGO.length_m < BUMPER_M)
        first = int(np.argmin(np.where(inside, part, np.inf)))
        xy = start[first, :2] + part[first] * way[first, :2]
        return bool(at_front.any()), ((float(xy[0]), float(xy[1])), Surface(int(surface[first])))


def collide(
    box: Box, ego: BicycleState, users: RoadUsers, met: tuple[tuple[int, float], ...], t_s: float
) -> tuple[list[Event], tuple[tuple[int, float], ...]]:
    """Return the new collisions of the ego vehicle's box with road users, and the updated contact times.

    Args:
        met: contact times so far, as `Contacts.users`.
    """
    velocity = ego.speed_mps * np.array([np.cos(ego.yaw_rad), np.sin(ego.yaw_rad)])
    known, events = dict(met), []
    for i in np.flatnonzero(touched(box, users)).tolist():
        track, category = int(users.track_id[i]), Category(int(users.category[i]))
        if t_s - known.get(track, -np.inf) > SAME_S:
            kind = "pedestrian" if category is Category.PEDESTRIAN else "vehicle"
            impact_mps = float(np.hypot(*(velocity - users.velocity_mps[i])))
            where = (float(users.foot_m[i, 0]), float(users.foot_m[i, 1]))
            text = f"{category.name.lower()} {track} at {impact_mps:.1f} m/s"
            events.append(Event(f"collision_{kind}", t_s, where, text, category.name.lower(), impact_mps))
        known[track] = t_s
    return events, tuple((track, at_s) for track, at_s in known.items() if t_s - at_s <= SAME_S)


def blocked(box: Box, users: RoadUsers) -> bool:
    """Return whether a vehicle stands directly in front of the bumper."""
    forward = np.array([np.cos(box.yaw_rad), np.sin(box.yaw_rad), 0.0])
    half = np.array([0.5 * BUMPER_M, box.half_lw[1] - FLANK_M])
    bumper = Box(box.foot_m + (box.half_lw[0] - half[0]) * forward, box.yaw_rad, half)
    return bool((touched(bumper, users) & (users.category != Category.PEDESTRIAN)).any())


def ego_box(T_world_ego: Float64[np.ndarray, "4 4"], ego: BicycleState, vehicle: Vehicle = EGO) -> Box:
    """Return the box of the ego vehicle."""
    foot = T_world_ego[:3, 3] + vehicle.axle_to_centre_m * T_world_ego[:3, 0]
    return Box(foot, ego.yaw_rad, 0.5 * np.array([vehicle.length_m, vehicle.width_m]))
