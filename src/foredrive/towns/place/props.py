"""Objects on posts: traffic lights, signs of the map, and street lamps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float, Int

from foredrive.towns.map.town_map import StopZone, StopZoneKind, TownMap
from foredrive.towns.place.materials import Material, MaterialTable, Surface, Texture
from foredrive.towns.place.mesh import Mesh, box, frustum, join
from foredrive.towns.place.site import Site, frontages

LAMP_SPACING_M, LAMP_HEIGHT_M, LAMP_ARM_M = 30.0, 7.5, 1.6
LAMP_SETBACK_M = 0.5
MAST_HEIGHT_M, HEAD_GAP_M = 5.6, 3.0
MAX_ARM_M = 9.0
SIGN_HEIGHT_M = 2.3
POST_CLEARANCE_M = 0.3
POLE_SAMPLE_M = 0.2


@dataclass(frozen=True)
class SignalHead:
    """The materials of one traffic light's lamps in the material table: red, yellow, green."""

    zone: int
    """Index into the town's stop zones."""
    lamps: tuple[int, int, int]


@dataclass(frozen=True)
class StreetLamps:
    """The light sources along the streets at night."""

    xyz: Float[np.ndarray, "N 3"]
    material: int
    """Look of the luminous part."""


@dataclass(frozen=True)
class Props:
    """All objects of a town that stand on posts."""

    mesh: Mesh
    heads: tuple[SignalHead, ...]
    thin: "ThinPoints"
    lamps: StreetLamps


@dataclass(frozen=True)
class ThinPoints:
    """Points along posts and trunks, which a grid of vertical rays would miss."""

    xyz: Float[np.ndarray, "N 3"]
    surface: Int[np.ndarray, "N"]


@dataclass
class _Materials:
    table: MaterialTable

    def __post_init__(self) -> None:
        add = self.table.add
        self.metal = add(Material(Surface.POLE, Texture.PLAIN, (0.42, 0.43, 0.44), 0.45, gloss=0.03))
        self.dark = add(Material(Surface.SIGNAL, Texture.PLAIN, (0.16, 0.17, 0.17), 0.25))
        self.lamp = add(Material(Surface.POLE, Texture.PLAIN, (0.90, 0.90, 0.86), 0.6))
        self.red_sign = add(Material(Surface.SIGN, Texture.PLAIN, (0.75, 0.09, 0.09), 1.0))
        self.white_sign = add(Material(Surface.SIGN, Texture.PLAIN, (0.92, 0.92, 0.92), 1.0))


def build_posts(town: TownMap, site: Site, table: MaterialTable) -> Props:
    """Build traffic lights and signs at their places in the map, moved off the lanes.

    They are placed first.
    """
    mats = _Materials(table)
    parts, heads, poles = [], [], []
    lanes = site.plan.lanes
    shapely.prepare(lanes)
    for index, zone in enumerate(town.stop_zones):
        # The post stands off the lanes, and nothing else may stand where it does
        foot = _off_lanes(zone, lanes)
        if foot is None:
            continue
        site.take(shapely.Point(foot[:2]).buffer(0.4))
        z = float(site.height(foot[None, :2])[0])
        if zone.kind is StopZoneKind.TRAFFIC_LIGHT:
            lamps = _lamp_materials(table, index)
            parts.append(_traffic_light(town, zone, np.array([*foot[:2], z]), lamps, mats))
            heads.append(SignalHead(index, lamps))
            poles.append(pole_points(foot, z, MAST_HEIGHT_M))
        else:
            parts.append(_stop_or_yield(zone, np.array([*foot[:2], z]), mats))
            poles.append(pole_points(foot, z, SIGN_HEIGHT_M))
    unlit = StreetLamps(np.zeros((0, 3)), mats.lamp)
    return Props(join(parts), tuple(heads), thin_points(poles, Surface.POLE), unlit)


def build_street_lamps(site: Site, table: MaterialTable, rng: np.random.Generator) -> Props:
    """Build lamps along the roads."""
    mats = _Materials(table)
    parts, poles, lamps = [], [], []
    for frontage in frontages(site.plan, LAMP_SETBACK_M):
        # A lamp wherever there is room, with its arm over the road on the left
        for s in np.arange(rng.uniform(0.0, LAMP_SPACING_M), frontage.line.length, LAMP_SPACING_M):
            foot = frontage.at(s)
            if site.is_free(shapely.Point(foot).buffer(0.25)):
                site.take(shapely.Point(foot).buffer(0.4))
                ahead = frontage.at(min(s + 0.5, frontage.line.length)) - foot
                z = float(site.height(foot[None])[0])
                parts.append(_lamp(foot, z, ahead, mats))
                over_road = (LAMP_ARM_M + 0.2) * np.array([-ahead[1], ahead[0]]) / np.linalg.norm(ahead)
                lamps.append([*(foot + over_road), z + LAMP_HEIGHT_M + 0.1])
                poles.append(pole_points(foot, z, LAMP_HEIGHT_M))
    thin = thin_points(poles, Surface.POLE)
    return Props(join(parts), (), thin, StreetLamps(np.array(lamps).reshape(-1, 3), mats.lamp))


def _off_lanes(zone: StopZone, lanes: shapely.Geometry) -> Float[np.ndarray, "3"] | None:
    """Move the foot of a post to the right of the traffic until it is off the lanes.

    Return None if that takes 4 m or more.
    """
    right = np.array([np.sin(zone.post_yaw), -np.cos(zone.post_yaw), 0.0])
    for step in np.arange(0.0, 4.0, 0.25):
        foot = zone.post_xyz + step * right
        if not lanes.intersects(shapely.Point(foot[:2]).buffer(POST_CLEARANCE_M)):
            return foot
    return None


def _lamp_materials(table: MaterialTable, zone: int) -> tuple[int, int, int]:
    """Return the materials of a light's three lamps, unlit.

    The zone separates them from those of other lights.
    """
    off = ((0.24, 0.05, 0.05), (0.24, 0.17, 0.04), (0.04, 0.20, 0.10))
    # The zone as a parameter makes each light's materials its own, so that they can be switched singly
    red, yellow, green = (
        table.add(Material(Surface.SIGNAL, Texture.PLAIN, rgb, 0.3, params=(0.0, float(zone)))) for rgb in off
    )
    return red, yellow, green


def _turned(mesh: Mesh, xyz: Float[np.ndarray, "3"], yaw: float) -> Mesh:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = xyz
    return mesh.transformed(T)


def _traffic_light(
    town: TownMap, zone: StopZone, foot: Float[np.ndarray, "3"], lamps: tuple[int, int, int], mats: _Materials
) -> Mesh:
    """Build a post with a head at eye level.

    If it serves several lanes, add an arm with one head for each lane.
    """
    # In the post's frame x points along the traffic, so the lights face the negative x direction.
    parts = [frustum((0, 0, -0.3), (0, 0, MAST_HEIGHT_M), (0.1, 0.08), 8, mats.metal)]
    parts.append(_head(np.array([-0.22, 0.0, 2.6]), lamps, mats))
    lanes = {lane.lane_id: lane for lane in town.lanes}
    left = np.array([-np.sin(zone.post_yaw), np.cos(zone.post_yaw)])
    # Lateral positions of the lanes that the light guards, as seen from the post
    starts = np.array([lanes[i].centreline_xyz[0, :2] for i in zone.lane_ids])
    across = np.unique(((starts - foot[:2]) @ left).round(1))
    # Lanes close to the post need no arm, and very distant ones get none
    reach = across[(np.abs(across) > 2.0) & (np.abs(across) < MAX_ARM_M)]
    if len(reach):
        tip = reach[np.abs(reach).argmax()]
        end = (0.0, float(tip), MAST_HEIGHT_M - 0.1)
        # An arm to the farthest lane, with heads at least `HEAD_GAP_M` apart
        parts.append(frustum((0.0, 0.0, MAST_HEIGHT_M - 0.15), end, (0.07, 0.05), 6, mats.metal))
        last = None
        for y in sorted(reach, key=abs):
            if last is None or abs(y - last) >= HEAD_GAP_M:
                parts.append(_head(np.array([-0.2, y, MAST_HEIGHT_M - 0.75]), lamps, mats))
                last = y
    return _turned(join(parts), foot, zone.post_yaw)


def _head(centre: Float[np.ndarray, "3"], lamps: tuple[int, int, int], mats: _Materials) -> Mesh:
    x, y, z = centre
    parts = [box((x - 0.1, y - 0.17, z - 0.5), (x + 0.1, y + 0.17, z + 0.5), mats.dark)]
    for lamp, dz in zip(lamps, (0.3, 0.0, -0.3), strict=True):
        disc = frustum((x - 0.1, y, z + dz), (x - 0.13, y, z + dz), (0.12, 0.12), 8, lamp)
        parts.append(disc)
    return join(parts)


def _stop_or_yield(zone: StopZone, foot: Float[np.ndarray, "3"], mats: _Materials) -> Mesh:
    sides = 8 if zone.kind is StopZoneKind.STOP_SIGN else 3
    pole = frustum((0, 0, -0.3), (0, 0, SIGN_HEIGHT_M), (0.035, 0.035), 6, mats.metal)
    rim = frustum((-0.05, 0, SIGN_HEIGHT_M), (-0.08, 0, SIGN_HEIGHT_M), (0.42, 0.42), sides, mats.white_sign)
    inner = mats.red_sign if sides == 8 else mats.white_sign
    outer = (
        rim
        if sides == 8
        else frustum((-0.05, 0, SIGN_HEIGHT_M), (-0.08, 0, SIGN_HEIGHT_M), (0.45, 0.45), 3, mats.red_sign)
    )
    face_m = 0.37 if sides == 8 else 0.28
    face = frustum((-0.08, 0, SIGN_HEIGHT_M), (-0.09, 0, SIGN_HEIGHT_M), (face_m, face_m), sides, inner)
    return _turned(join([pole, outer, face]), foot, zone.post_yaw)


def _lamp(foot: Float[np.ndarray, "2"], z: float, ahead: Float[np.ndarray, "2"], mats: _Materials) -> Mesh:
    """Build a street lamp whose arm reaches over the road, to the left of `ahead`."""
    top = LAMP_HEIGHT_M
    parts = [
        frustum((0, 0, -0.5), (0, 0, top), (0.09, 0.05), 6, mats.metal),
        frustum((0, 0, top - 0.05), (0, LAMP_ARM_M, top + 0.25), (0.04, 0.03), 5, mats.metal),
        box((-0.12, LAMP_ARM_M - 0.1, top + 0.14), (0.12, LAMP_ARM_M + 0.5, top + 0.26), mats.lamp),
    ]
    return _turned(join(parts), np.array([*foot, z]), float(np.arctan2(ahead[1], ahead[0])))


def pole_points(foot: Float[np.ndarray, "_"], z: float, height: float) -> Float[np.ndarray, "n 3"]:
    """Return points up a pole."""
    up = np.arange(0.0, height, POLE_SAMPLE_M)
    return np.column_stack([np.full_like(up, foot[0]), np.full_like(up, foot[1]), z + up])


def thin_points(lines: list[Float[np.ndarray, "_ 3"]], surface: Surface) -> ThinPoints:
    """Return thin points of one surface."""
    xyz = np.concatenate([np.zeros((0, 3)), *lines])
    return ThinPoints(xyz, np.full(len(xyz), int(surface)))


def join_thin_points(parts: Sequence[ThinPoints]) -> ThinPoints:
    """Join thin points."""
    return ThinPoints(np.concatenate([p.xyz for p in parts]), np.concatenate([p.surface for p in parts]))
