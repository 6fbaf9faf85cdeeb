"""Trees and bushes along walkways and in the open."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import trimesh
from jaxtyping import Float

from foredrive.towns.place.assets import Assets
from foredrive.towns.place.materials import Material, MaterialTable, Surface, Texture
from foredrive.towns.place.mesh import Mesh, frustum, join, triangles
from foredrive.towns.place.props import ThinPoints, pole_points, thin_points
from foredrive.towns.place.site import Site, frontages

TREE_SETBACK_M = 1.5
TREE_SPACING_M = (7.0, 15.0)
STREET_TREES, OPEN_TREES_PER_M2 = 0.6, 1 / 260.0
MIN_TREE_M, MAX_TREE_M = 5.0, 80.0
NEAR_M = 22.0
"""Maximum distance from the roads at which trees have leaves that stick out, m."""
TRUNK_M = 2.0
CROWN_SPREAD = 1.35
VARIANTS = 5
BARK, LEAVES = 0, 1
"""Placeholders for the materials of a tree until it is placed."""

RADIUS_M = {
    "round": (1.6, 2.8),
    "tall": (1.0, 1.6),
    "conifer": (0.8, 1.5),
    "bush": (0.8, 1.4),
    "poplar": (0.8, 1.2),
    "willow": (1.8, 2.8),
    "palm": (1.5, 2.2),
    "hedge_ball": (0.6, 0.9),
}
_LOW = ("bush", "conifer", "hedge_ball")
"""Kinds whose leaves reach so far down that people cannot walk below them."""
_SPHERE, _COARSE = trimesh.creation.icosphere(subdivisions=1), trimesh.creation.icosahedron()


def build_vegetation(
    site: Site, assets: Assets, table: MaterialTable, rng: np.random.Generator
) -> tuple[Mesh, ThinPoints]:
    """Place plants on the land that is still free and take their places from the site."""
    maker = _PlantMaker(assets, table, rng)
    parts, trunks = [], []
    spots = np.array(_street_tree_spots(site, rng) + _open_tree_spots(site, rng)).reshape(-1, 2)
    near = site.distance_to_road(spots) < NEAR_M
    for xy, detail in zip(spots, near, strict=True):
        kind = assets.trees[int(rng.integers(len(assets.trees)))]
        radius = float(rng.uniform(*RADIUS_M[kind]))
        # Plants need room for their crown; what stands in the way is left out
        if not _has_room(site, xy, kind, radius):
            continue
        site.take(shapely.Point(xy).buffer(0.6))
        foot = np.array([*xy, float(site.height(xy[None])[0])])
        parts.append(maker.plant(kind, foot, radius, bool(detail)))
        trunks.append(pole_points(xy, foot[2], TRUNK_M if kind not in _LOW else 0.5))
    return join(parts), thin_points(trunks, Surface.VEGETATION)


def _street_tree_spots(site: Site, rng: np.random.Generator) -> list[Float[np.ndarray, "2"]]:
    spots = []
    for frontage in frontages(site.plan, TREE_SETBACK_M):
        s = rng.uniform(*TREE_SPACING_M)
        while s < frontage.line.length:
            if rng.random() < STREET_TREES:
                spots.append(frontage.at(s) + rng.normal(0.0, 0.2, 2))
            s += rng.uniform(*TREE_SPACING_M)
    return spots


def _open_tree_spots(site: Site, rng: np.random.Generator) -> list[Float[np.ndarray, "2"]]:
    """Return spots for clumps of trees on the remaining land."""
    terrain = site.terrain
    extent = np.array(terrain.z.shape[::-1]) * 4.0
    count = int(extent.prod() * OPEN_TREES_PER_M2)
    xy = terrain.origin_xy + rng.random((count, 2)) * extent
    away = site.distance_to_road(xy)
    # Smooth waves decide where trees stand close together
    clump = np.sin(xy[:, 0] / 17.0 + 1.3 * np.sin(xy[:, 1] / 23.0)) + np.sin(xy[:, 1] / 19.0)
    wanted = (away > MIN_TREE_M) & (away < MAX_TREE_M) & (clump > rng.uniform(-0.6, 1.6, count))
    return list(xy[wanted])


def _has_room(site: Site, xy: Float[np.ndarray, "2"], kind: str, radius: float) -> bool:
    if not site.is_free(shapely.Point(xy).buffer(0.35)):
        return False
    # The crown reaches beyond the nominal radius
    spread = shapely.Point(xy).buffer(CROWN_SPREAD * radius, quad_segs=2)
    if kind in _LOW:
        return site.is_free(spread)
    # A crown may hang over a walkway.
    if site.plan.lanes.intersects(spread) or site.plan.bridges.intersects(spread):
        return False
    return not any(other.intersects(spread) for other in site.near(spread))


@dataclass
class _PlantMaker:
    """A few plants of each kind. Each placed plant is a rotated and scaled copy of one of them."""

    assets: Assets
    table: MaterialTable
    rng: np.random.Generator

    def __post_init__(self) -> None:
        bark = Material(Surface.VEGETATION, Texture.PLAIN, (0.36, 0.29, 0.23), 0.35, params=(2.0,))
        self._bark = self.table.add(bark)
        self._leaves = [self._foliage(rgb, 0.5) for rgb in self.assets.leaves]
        self._needles = [self._foliage(rgb, 0.45) for rgb in self.assets.needles]
        self._grown = {
            (kind, detail): [_grow(kind, detail, self.rng) for _ in range(VARIANTS)]
            for kind in dict.fromkeys(self.assets.trees)
            for detail in (False, True)
        }

    def _foliage(self, rgb: tuple[float, float, float], reflectivity: float) -> int:
        return self.table.add(Material(Surface.VEGETATION, Texture.FOLIAGE, rgb, reflectivity))

    def plant(self, kind: str, foot: Float[np.ndarray, "3"], radius: float, detail: bool) -> Mesh:
        """Return a plant whose crown has about this radius (m)."""
        rng = self.rng
        grown = self._grown[kind, detail][int(rng.integers(VARIANTS))]
        # A copy is turned, scaled to the radius, and stretched in height at random
        angle, rise = rng.uniform(0.0, 2.0 * np.pi), radius * rng.uniform(0.85, 1.2)
        T = np.eye(4)
        T[:2, :2] = radius * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        T[2, 2], T[:3, 3] = rise, foot
        colours = self._needles if kind == "conifer" else self._leaves
        leaves = colours[-1] if kind == "palm" else colours[int(rng.integers(len(colours)))]
        moved = grown.transformed(T)
        # Placeholders become bark and leaves
        material = np.where(grown.material == BARK, self._bark, leaves).astype(np.int32)
        return Mesh(moved.xyz, np.zeros_like(moved.uvw), material)


def _grow(kind: str, detail: bool, rng: np.random.Generator) -> Mesh:
    """Build a plant on z = 0 with a crown of radius 1."""
    if kind in ("bush", "hedge_ball"):
        return _crown((0.0, 0.0, 0.55), (1.0, 1.0, 0.75 if kind == "bush" else 1.0), detail, rng)
    if kind == "conifer":
        return _conifer(rng, detail)
    if kind == "palm":
        return _palm(rng)
    # Height of the crown in radii, and height of the trunk
    stretch = {"round": 1.0, "tall": 2.0, "poplar": 3.6, "willow": 0.8}[kind]
    trunk = {"round": 1.25, "tall": 2.0, "poplar": 1.2, "willow": 1.6}[kind] * rng.uniform(0.9, 1.1)
    middle = (0.0, 0.0, trunk + 0.9 * stretch)
    parts = [
        frustum((0, 0, -0.2), middle, (0.09, 0.04), 6, BARK),
        _crown(middle, (1.0, 1.0, stretch), detail, rng),
    ]
    # Smaller crowns around the main one
    if kind in ("round", "willow"):
        for angle in rng.uniform(0.0, 2.0 * np.pi) + np.array([0.0, 2.2, 4.1]):
            offset = 0.55 * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.25, 0.5) * stretch])
            r = rng.uniform(0.55, 0.7)
            parts.append(_crown(np.array(middle) + offset, (r, r, 0.85 * r), False, rng))
    # Hanging branches around the crown
    if kind == "willow":
        for angle in np.arange(14) * 0.45 + rng.uniform(0.0, 0.3, 14):
            ahead = np.array([np.cos(angle), np.sin(angle), 0.0])
            top = np.array(middle) + rng.uniform(0.7, 1.0) * ahead + [0.0, 0.0, 0.1]
            parts.append(_leaf(top, top + 0.15 * ahead - [0.0, 0.0, rng.uniform(0.8, 1.5)], 0.22, rng))
    return join(parts)


def _conifer(rng: np.random.Generator, detail: bool) -> Mesh:
    parts = [frustum((0, 0, -0.2), (0, 0, 1.3), (0.14, 0.11), 5, BARK)]
    height, tiers = rng.uniform(4.6, 6.2), 5 if detail else 3
    # Cones that overlap and become narrower towards the top
    for k in range(tiers):
        share = k / tiers
        low, top = 0.6 + share * height, 0.6 + min(share + 1.5 / tiers, 1.0) * height
        parts.append(frustum((0, 0, low), (0, 0, top), (1.15 * (1.0 - 0.8 * share), 0.0), 8, LEAVES))
    mesh = join(parts)
    # A wavy outline instead of circles
    sway = 1.0 + 0.1 * np.sin(7.0 * mesh.xyz[..., :1] + 5.0 * mesh.xyz[..., 1:2] + 3.0 * mesh.xyz[..., 2:])
    xyz = np.concatenate([mesh.xyz[..., :2] * sway, mesh.xyz[..., 2:]], axis=-1)
    return Mesh(xyz.astype(np.float32), mesh.uvw, mesh.material)


def _palm(rng: np.random.Generator) -> Mesh:
    top = np.array([0.12, 0.0, rng.uniform(3.0, 4.0)])
    parts = [frustum((0, 0, -0.2), tuple(top), (0.12, 0.08), 6, BARK)]
    for angle in np.arange(11) * 0.571 + rng.uniform(0.0, 0.25, 11):
        ahead = np.array([np.cos(angle), np.sin(angle), 0.0])
        bend = top + 0.6 * ahead + [0.0, 0.0, rng.uniform(0.1, 0.35)]
        parts.append(_leaf(top, bend, 0.2, rng))
        parts.append(_leaf(bend, top + 1.1 * ahead - [0.0, 0.0, rng.uniform(0.1, 0.6)], 0.22, rng))
    return join(parts)


def _crown(
    centre: Sequence[float] | Float[np.ndarray, "3"],
    radii: tuple[float, float, float],
    detail: bool,
    rng: np.random.Generator,
) -> Mesh:
    """Build an irregular ball of leaves. With detail, twigs stick out of it."""
    ball = _SPHERE if detail else _COARSE
    inner = 0.9 if detail else 1.05
    # Each vertex of the ball at a random distance
    lumps = inner * rng.uniform(0.8, 1.15, (len(ball.vertices), 1))
    parts = [triangles((np.asarray(centre) + ball.vertices * lumps * radii)[ball.faces], LEAVES)]
    if detail:
        out = rng.normal(size=(26, 3))
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        # Twigs: clumps of leaves across the crown's surface
        for direction in out:
            side = np.cross(direction, rng.normal(size=3))
            root = np.asarray(centre) + 0.86 * direction * radii - 0.26 * side
            tip = np.asarray(centre) + 1.04 * direction * radii + 0.26 * side
            parts.append(_leaf(root, tip, 0.34, rng))
    return join(parts)


_OCTAHEDRON = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
)


def _leaf(
    root: Float[np.ndarray, "3"], tip: Float[np.ndarray, "3"], width: float, rng: np.random.Generator
) -> Mesh:
    """Build a clump of leaves: a flat octahedron from root to tip."""
    along = 0.5 * (tip - root)
    # Width across the clump, and a third of it as thickness
    across = np.cross(along, rng.normal(size=3))
    across *= width / max(float(np.linalg.norm(across)), 1e-6)
    thick = np.cross(along, across)
    thick *= 0.35 * width / max(float(np.linalg.norm(thick)), 1e-6)
    middle = 0.5 * (root + tip)
    corners = np.array(
        [middle + along, middle - along, middle + across, middle - across, middle + thick, middle - thick]
    )
    return triangles(corners[_OCTAHEDRON], LEAVES)
