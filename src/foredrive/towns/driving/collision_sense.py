"""Collisions of the ego vehicle in a town: with road users by their boxes, with static objects by meshes."""

import numpy as np
from jaxtyping import Float32, Float64

from foredrive.driving.collisions import (
    BUMPER_M,
    FLANK_M,
    SAME_M,
    Contacts,
    RoadUsers,
    blocked,
    collide,
    ego_box,
)
from foredrive.driving.dynamics import EGO
from foredrive.scene import BicycleState, Event
from foredrive.towns.place.materials import Surface
from foredrive.towns.world import World

PASSABLE = (Surface.ROAD, Surface.SIDEWALK, Surface.TERRAIN, Surface.HIDDEN)
SOLID = np.array([surface not in PASSABLE for surface in Surface])
RAY_HEIGHTS_M = (0.35, 0.8)
RAY_SPACING_M = 0.12
"""Lateral distance between rays, m: posts are not much thinner."""


class CollisionSense:
    """Detects the collisions of the ego vehicle in one world."""

    def __init__(self, world: World) -> None:
        self._world = world
        half_width, length = 0.5 * EGO.width_m, EGO.length_m
        # Rays start at the front bumper, across the width and at two heights
        y = np.linspace(-half_width, half_width, int(np.ceil(EGO.width_m / RAY_SPACING_M)) + 1)
        start = [[EGO.axle_to_centre_m + 0.5 * length, left, up] for up in RAY_HEIGHTS_M for left in y]
        self._start_ego: Float64[np.ndarray, "R 3"] = np.array(start)
        # The outermost rays scrape along the flanks; only the others count as a frontal contact
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
            # The same object is reported once until another place is struck
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
        # Each ray runs the vehicle's length backwards, so `part` is the depth of the hit as a share of it
        way = np.broadcast_to(-EGO.length_m * R[:, 0], start.shape)
        rays: list[Float32[np.ndarray, "R 3"]] = [np.ascontiguousarray(x, np.float32) for x in (start, way)]
        part, surface = self._world.struck(*rays)
        inside = (part <= 1.0) & SOLID[surface]
        if not inside.any():
            return False, None
        # Only a hit within `BUMPER_M` of the bumper, and not at the flanks, stops the vehicle
        at_front = inside & self._in_front & (part * EGO.length_m < BUMPER_M)
        first = int(np.argmin(np.where(inside, part, np.inf)))
        xy = start[first, :2] + part[first] * way[first, :2]
        return bool(at_front.any()), ((float(xy[0]), float(xy[1])), Surface(int(surface[first])))
