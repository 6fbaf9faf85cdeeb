"""Parked cars in the map's parking strips and on small car parks beside the road."""

import numpy as np
import shapely
from jaxtyping import Float

from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import Category
from foredrive.scene.actors import ActorState
from foredrive.towns.map.town_map import StripKind, TownMap
from foredrive.towns.place.materials import ASPHALT_RGB, Material, MaterialTable, Surface, Texture
from foredrive.towns.place.mesh import Mesh, join, quads, ribbon, walls
from foredrive.towns.place.site import Frontage, Site, frontages

FIRST_TRACK_ID = 50_000
"""First track id of parked cars, so that they never share an id with traffic."""
SHARE_OF_BAYS = 0.6
KERB_BAY_M, KERB_WIDTH_M = 6.2, 2.0
CROSS_BAY_M, CROSS_DEPTH_M = 2.8, 5.2
LOT_SPACING_M, LOT_SETBACK_M, LOT_DEPTH_M = 110.0, 0.8, 11.5
LOT_WIDTH_M = (14.0, 28.0)
LOT_SLOPE_M = 0.25
LOT_LIFT_M = 0.06


def park_on_strips(town: TownMap, site: Site, rng: np.random.Generator) -> list[ActorState]:
    """Place cars on parking strips, along the kerb or, on deep strips, across it. No car stands on a lane."""
    lanes = site.plan.lanes
    shapely.prepare(lanes)
    cars: list[ActorState] = []
    for strip in town.strips_of(StripKind.PARKING):
        # Bays along the middle of the strip; on deep strips cars stand across it
        middle = 0.5 * (strip.left_xyz + strip.right_xyz)
        along = arc_lengths(middle)
        width = np.linalg.norm(strip.left_xyz - strip.right_xyz, axis=1)
        across = float(np.median(width)) >= CROSS_DEPTH_M
        bay = CROSS_BAY_M if across else KERB_BAY_M
        for s in np.arange(0.5 * bay + 1.0, along[-1] - 0.5 * bay - 1.0, bay):
            # Some bays stay empty, and the strip may be too narrow in places
            if rng.random() > SHARE_OF_BAYS or np.interp(s, along, width) < KERB_WIDTH_M:
                continue
            car = _car(_pose_on(middle, along, s), across, rng)
            # Not on a lane, and not into the cars placed just before
            if not lanes.intersects(footprint(car).buffer(0.05)) and all(
                not footprint(car).intersects(footprint(other)) for other in cars[-3:]
            ):
                cars.append(car)
    return cars


def build_car_parks(
    site: Site, table: MaterialTable, rng: np.random.Generator
) -> tuple[Mesh, list[ActorState]]:
    """Build paved car parks between the buildings, each with a row of marked bays.

    The plots are taken from the site.
    """
    asphalt = table.add(Material(Surface.TERRAIN, Texture.ROAD, ASPHALT_RGB, 0.15))
    paint = table.add(Material(Surface.TERRAIN, Texture.PLAIN, (0.85, 0.85, 0.83), 0.7))
    parts, cars = [], []
    for frontage in frontages(site.plan, LOT_SETBACK_M):
        if not frontage.walkway:
            continue
        # Car parks at random distances along the walkway
        s = rng.uniform(0.2, 1.0) * LOT_SPACING_M
        while s < frontage.line.length - LOT_WIDTH_M[1]:
            mesh, parked = _lot(site, frontage, s, (asphalt, paint), rng)
            parts += mesh
            cars += parked
            s += rng.uniform(0.7, 1.3) * LOT_SPACING_M
    return join(parts), cars


def footprint(actor: ActorState) -> shapely.Polygon:
    """Return an actor's box seen from above."""
    ahead = np.array([np.cos(actor.yaw), np.sin(actor.yaw)])
    left = np.array([-ahead[1], ahead[0]])
    x, y = 0.5 * actor.size_lwh[0] * ahead, 0.5 * actor.size_lwh[1] * left
    centre = actor.centre_m[:2]
    return shapely.Polygon([centre + x + y, centre - x + y, centre - x - y, centre + x - y])


def with_track_ids(cars: list[ActorState]) -> tuple[ActorState, ...]:
    """Return parked cars with their track ids."""
    return tuple(
        ActorState(**{**vars(car), "track_id": FIRST_TRACK_ID + number}) for number, car in enumerate(cars)
    )


def _pose_on(
    middle: Float[np.ndarray, "N 3"], along: Float[np.ndarray, "N"], s: float
) -> tuple[Float[np.ndarray, "3"], float, float]:
    """Return the point, heading and pitch on a strip."""
    # Heading and pitch from the points 2 m before and after
    middle_xyz, before, after = (points_at(middle, along, s + ds) for ds in (0.0, -2.0, 2.0))
    step = after - before
    # The pitch is positive with the nose down
    return (
        middle_xyz,
        float(np.arctan2(step[1], step[0])),
        float(-np.arctan2(step[2], np.hypot(step[0], step[1]))),
    )


def _car(
    pose: tuple[Float[np.ndarray, "3"], float, float], across: bool, rng: np.random.Generator
) -> ActorState:
    xyz, yaw, pitch = pose
    van = rng.random() < 0.1
    size = np.array([rng.uniform(3.9, 4.8), rng.uniform(1.72, 1.86), rng.uniform(1.42, 1.7)])
    if van:
        size = np.array([rng.uniform(5.05, 5.2), 1.95, rng.uniform(2.0, 2.3)])
    yaw += rng.normal(0.0, 0.02) + (0.5 * np.pi if across else 0.0)
    # Some cars face the other way; their pitch changes sign
    if rng.random() < 0.15:
        yaw += np.pi
        pitch = -pitch
    return ActorState(
        track_id=-1,
        category=Category.CAR,
        centre_m=xyz + np.array([0.0, 0.0, 0.5 * size[2]]),
        yaw=yaw,
        pitch=0.0 if across else pitch,
        size_lwh=size,
        velocity_mps=np.zeros(3),
        style=int(rng.integers(2**31)),
        parked=True,
    )


def _lot(
    site: Site, frontage: Frontage, s: float, materials: tuple[int, int], rng: np.random.Generator
) -> tuple[list[Mesh], list[ActorState]]:
    asphalt, paint = materials
    # The road lies to the left of the line; local x runs along the road, y away from it
    end, start = frontage.at(s), frontage.at(s + rng.uniform(*LOT_WIDTH_M))
    width = float(np.linalg.norm(end - start))
    along = (end - start) / width
    into = np.array([-along[1], along[0]])

    def world(x: float, y: float) -> Float[np.ndarray, "2"]:
        return start + x * along + y * into

    ring = np.array([world(0.0, 0.0), world(width, 0.0), world(width, LOT_DEPTH_M), world(0.0, LOT_DEPTH_M)])
    area = shapely.Polygon(ring)
    # The ground must be level within `LOT_SLOPE_M`, and free
    heights = site.height(np.concatenate([ring, [ring.mean(axis=0)]]))
    if not site.is_free(area.buffer(0.3)) or np.ptp(heights) > LOT_SLOPE_M:
        return [], []
    site.take(area)
    # Level with the highest corner; the walls reach down into the ground
    z = float(heights.max()) + LOT_LIFT_M
    closed = np.concatenate([ring, ring[:1]])
    top = np.column_stack([ring, np.full(4, z)])
    parts = [quads(top[None], asphalt, np.zeros((1, 4, 3))), walls(closed, z - 1.0, z, asphalt)]
    cars = []
    bays = int((width - 1.0) / CROSS_BAY_M)
    # Lines between the bays at the back; cars stand between them with their front to the back
    for bay in range(bays + 1):
        x = 0.5 * (width - bays * CROSS_BAY_M) + bay * CROSS_BAY_M
        line = [world(x, LOT_DEPTH_M - 0.4), world(x, LOT_DEPTH_M - CROSS_DEPTH_M)]
        foot = np.column_stack([line, np.full(2, z + 0.008)])
        half = np.array([*(0.05 * along), 0.0])
        parts.append(ribbon(foot + half, foot - half, paint))
        if bay < bays and rng.random() < SHARE_OF_BAYS:
            xy = world(x + 0.5 * CROSS_BAY_M, LOT_DEPTH_M - 0.4 - 0.5 * CROSS_DEPTH_M)
            heading = float(np.arctan2(into[1], into[0]))
            cars.append(_car((np.array([*xy, z]), heading, 0.0), False, rng))
    return parts, cars
