"""Buildings along the roads and behind them, grown from a seed."""

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

from foredrive.towns.place.looks import Look, LookTable, Surface, Texture
from foredrive.towns.place.mesh import Mesh, box, hexahedron, join, polygon_cap, quads, triangles, walls
from foredrive.towns.place.site import Frontage, Site, frontages

FOUNDATION_M = 1.5
PARAPET_M = 0.5
SETBACK_M = 3.0
CLEARANCE_M = 0.8
EAVES_M = 0.45
SKYLINE_TRIES_PER_M2 = 1 / 900.0
SKYLINE_NEAREST_M, SKYLINE_FURTHEST_M = 16.0, 75.0

_PLASTER = (
    (0.80, 0.76, 0.67),
    (0.76, 0.69, 0.58),
    (0.82, 0.81, 0.77),
    (0.72, 0.60, 0.50),
    (0.76, 0.78, 0.76),
    (0.76, 0.62, 0.51),
    (0.68, 0.70, 0.66),
    (0.80, 0.73, 0.57),
)
_BRICK = ((0.55, 0.36, 0.30), (0.62, 0.46, 0.37), (0.48, 0.33, 0.28), (0.67, 0.56, 0.46))
_CONCRETE = ((0.66, 0.65, 0.63), (0.58, 0.59, 0.60), (0.74, 0.72, 0.68))
_CURTAIN = ((0.42, 0.50, 0.56), (0.36, 0.40, 0.44), (0.50, 0.55, 0.55))
_ROOFS = ((0.50, 0.27, 0.20), (0.42, 0.24, 0.19), (0.34, 0.33, 0.34), (0.38, 0.30, 0.25))
_FLAT_ROOFS = ((0.46, 0.45, 0.44), (0.55, 0.53, 0.50), (0.36, 0.36, 0.37))
_AWNINGS = ((0.55, 0.12, 0.12), (0.12, 0.32, 0.20), (0.15, 0.25, 0.45), (0.80, 0.65, 0.30))


@dataclass(frozen=True)
class Style:
    """What a town builds: shares of houses, blocks and towers along walkways, and how densely."""

    houses: float
    towers: float
    storeys: tuple[int, int]
    """Of blocks."""
    density: float
    """Share of the frontage along walkways that is built on."""
    open_density: float
    """The same along roads without walkways."""
    skyline: float
    """Share of the free spots behind the first row that are built on."""


STYLES = {
    "Town01": Style(0.45, 0.0, (2, 4), 0.75, 0.3, 0.25),
    "Town02": Style(0.35, 0.0, (2, 5), 0.85, 0.3, 0.30),
    "Town03": Style(0.10, 0.2, (3, 7), 0.75, 0.3, 0.35),
    "Town04": Style(0.40, 0.1, (2, 5), 0.70, 0.12, 0.12),
    "Town05": Style(0.05, 0.2, (3, 8), 0.80, 0.15, 0.35),
    "Town06": Style(0.30, 0.05, (1, 4), 0.60, 0.25, 0.12),
    "Town07": Style(0.80, 0.0, (1, 2), 0.55, 0.22, 0.10),
    "Town10HD": Style(0.0, 0.4, (4, 10), 0.90, 0.3, 0.50),
}


@dataclass(frozen=True)
class Plot:
    """A rectangle to build on. Local x runs along the front with the street behind it, y into the plot."""

    corner: Float[np.ndarray, "2"]
    """Where the front begins, seen from inside on the left."""
    along: Float[np.ndarray, "2"]
    width_m: float
    depth_m: float

    @property
    def into(self) -> Float[np.ndarray, "2"]:
        """Unit direction away from the street."""
        return np.array([-self.along[1], self.along[0]])

    def world(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Map local points to the town."""
        return self.corner + xy[..., :1] * self.along + xy[..., 1:] * self.into

    def polygon(self, grow_m: float = 0.0) -> shapely.Polygon:
        """The rectangle in the town, grown on all sides."""
        w, d, g = self.width_m, self.depth_m, grow_m
        return shapely.Polygon(self.world(np.array([[-g, -g], [w + g, -g], [w + g, d + g], [-g, d + g]])))


def build_buildings(site: Site, town_name: str, table: LookTable, rng: np.random.Generator) -> Mesh:
    """Rows of buildings along the frontages, then a looser second row; takes their plots from the site."""
    style = STYLES[town_name]
    builder = _Builder(site, table, rng, style)
    parts = []
    for frontage in frontages(site.plan, SETBACK_M):
        parts += builder.row(frontage)
    parts += builder.skyline()
    return join(parts)


@dataclass
class _Builder:
    site: Site
    table: LookTable
    rng: np.random.Generator
    style: Style

    def row(self, frontage: Frontage) -> list[Mesh]:
        """Buildings side by side along one line."""
        rng, length = self.rng, frontage.line.length
        density = self.style.density if frontage.walkway else self.style.open_density
        parts, s = [], rng.uniform(0.0, 8.0)
        while s < length - 8.0:
            if rng.random() > density:
                s += rng.uniform(8.0, 22.0)
                continue
            kind = self._draw_kind()
            width, depth = self._draw_size(kind)
            a, b = frontage.at(s), frontage.at(min(s + width, length))
            back_m = 0.0 if frontage.walkway else rng.uniform(6.0, 16.0)
            back_m += rng.uniform(0.0, 5.0) if kind == "house" else rng.choice([0.0, 0.0, 0.6])
            plot = self._plot(b, a, depth, back_m)
            if plot is None or not self.site.is_free(plot.polygon(CLEARANCE_M)):
                s += 3.0
                continue
            parts.append(self._raise(plot, kind))
            s += width + (rng.uniform(0.2, 1.0) if kind == "block" else rng.uniform(2.0, 7.0)) + CLEARANCE_M
        return parts

    def skyline(self) -> list[Mesh]:
        """Free-standing buildings behind the first row."""
        rng, terrain = self.rng, self.site.terrain
        lower = terrain.origin_xy + 20.0
        extent = np.array(terrain.z.shape[::-1]) * 4.0 - 40.0
        count = int(extent.prod() * SKYLINE_TRIES_PER_M2)
        spots = lower + rng.random((count, 2)) * extent
        away = self.site.distance_to_road(spots)
        near = (away > SKYLINE_NEAREST_M) & (away < SKYLINE_FURTHEST_M)
        parts = []
        for xy in spots[near & (rng.random(count) < self.style.skyline)]:
            kind = self._draw_kind()
            width, depth = self._draw_size(kind)
            angle = rng.choice([0.0, 0.5 * np.pi]) + rng.normal(0.0, 0.05)
            along = np.array([np.cos(angle), np.sin(angle)])
            plot = Plot(xy, along, width, depth)
            if self.site.is_free(plot.polygon(3.0)):
                parts.append(self._raise(plot, kind))
        return parts

    def _draw_kind(self) -> str:
        u = self.rng.random()
        if u < self.style.houses:
            return "house"
        return "tower" if u < self.style.houses + self.style.towers else "block"

    def _draw_size(self, kind: str) -> tuple[float, float]:
        low, high = {"house": (8.0, 13.0), "block": (11.0, 26.0), "tower": (16.0, 26.0)}[kind]
        deep = {"house": (8.0, 11.0), "block": (10.0, 15.0), "tower": (14.0, 22.0)}[kind]
        return float(self.rng.uniform(low, high)), float(self.rng.uniform(*deep))

    @staticmethod
    def _plot(
        start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"], depth: float, back_m: float
    ) -> Plot | None:
        chord = end - start
        width = float(np.linalg.norm(chord))
        if width < 6.0:
            return None
        along = chord / width
        return Plot(start + back_m * np.array([-along[1], along[0]]), along, width, depth)

    def _raise(self, plot: Plot, kind: str) -> Mesh:
        self.site.take(plot.polygon(0.3))
        corners = plot.world(
            np.array([[0, 0], [plot.width_m, 0], [plot.width_m, plot.depth_m], [0, plot.depth_m]], float)
        )
        base = float(self.site.height(corners).min())
        if kind == "house":
            return self._house(plot, base)
        return self._block(plot, base, tower=kind == "tower")

    def _house(self, plot: Plot, base: float) -> Mesh:
        """One or two storeys under a gabled roof."""
        rng = self.rng
        storeys, ground_m, storey_m = int(rng.integers(1, 3)), 2.9, 2.8
        rgb = _choose(rng, _PLASTER if rng.random() < 0.65 else _BRICK)
        facade = self._facade(rgb, storey_m, 2.9, (0.42, 0.5), ground_m - 0.1, rgb in _BRICK)
        roof = self.table.add(Look(Surface.BUILDING, Texture.TILES, _choose(rng, _ROOFS), 0.35))
        eaves = base + ground_m + (storeys - 1) * storey_m
        w, d = plot.width_m, plot.depth_m
        pitch = rng.uniform(0.55, 0.85)
        ridge = eaves + pitch * 0.5 * d
        ring = np.array([[0, 0], [w, 0], [w, d], [0, d], [0, 0]], float)
        parts = [self._walls(plot.world(ring), base, eaves, facade)]
        parts.append(self._gable_roof(plot, eaves, ridge, roof, facade))
        if rng.random() < 0.6:
            x, y = rng.uniform(0.2, 0.7) * w, 0.5 * d + rng.uniform(0.3, 1.2)
            parts.append(self._local_box(plot, (x, y), (0.7, 0.7), (eaves, ridge + 0.9), facade))
        return join(parts)

    def _gable_roof(self, plot: Plot, eaves: float, ridge: float, roof: int, wall: int) -> Mesh:
        w, d, e = plot.width_m, plot.depth_m, EAVES_M
        drop = (ridge - eaves) / (0.5 * d) * e

        def at(x: float, y: float, z: float) -> list[float]:
            return [*plot.world(np.array([x, y])), z]

        slopes = []
        for side in (0, 1):
            y0 = -e if side == 0 else d + e
            x0, x1 = (-e, w + e) if side == 0 else (w + e, -e)
            corners = [at(x0, y0, eaves - drop), at(x1, y0, eaves - drop)]
            corners += [at(x1, 0.5 * d, ridge), at(x0, 0.5 * d, ridge)]
            run = float(np.hypot(0.5 * d + e, ridge - eaves + drop))
            uvw = np.array([[[0, 0, 0], [w, 0, 0], [w, run, 0], [0, run, 0]]], float)
            top = np.array([corners])
            slopes += [quads(top, roof, uvw), quads(top[:, ::-1] - [0.0, 0.0, 0.15], roof, uvw)]
        gables = np.array(
            [
                [at(w, 0.0, eaves), at(w, d, eaves), at(w, 0.5 * d, ridge - 0.1)],
                [at(0.0, d, eaves), at(0.0, 0.0, eaves), at(0.0, 0.5 * d, ridge - 0.1)],
            ]
        )
        return join([*slopes, triangles(gables, wall, np.zeros((2, 3, 3)))])

    def _block(self, plot: Plot, base: float, tower: bool) -> Mesh:
        """Several storeys under a flat roof; some with a notch in the back."""
        rng = self.rng
        low, high = self.style.storeys
        storeys = int(rng.integers(8, 17) if tower else rng.integers(low, high + 1))
        storey_m, ground_m = float(rng.uniform(2.9, 3.4)), float(rng.uniform(3.4, 4.4))
        facade = self._block_facade(storey_m, ground_m, tower)
        roof = self.table.add(
            Look(Surface.BUILDING, Texture.PLAIN, _choose(rng, _FLAT_ROOFS), 0.3, params=(1.0,))
        )
        top = base + ground_m + (storeys - 1) * storey_m + PARAPET_M
        w, d = plot.width_m, plot.depth_m
        outline = [[0, 0], [w, 0], [w, d], [0, d]]
        if w > 15.0 and rng.random() < 0.45:
            x, y = rng.uniform(0.35, 0.65) * w, rng.uniform(0.4, 0.6) * d
            outline = [[0, 0], [w, 0], [w, d], [x, d], [x, y], [0, y]]
        ring = plot.world(np.array([*outline, outline[0]], float))
        parts = [
            self._walls(ring, base, top, facade),
            polygon_cap(shapely.Polygon(ring), top - PARAPET_M, roof),
        ]
        for _ in range(int(rng.integers(1, 4))):
            size = rng.uniform(1.5, 4.0, 2)
            centre = (rng.uniform(0.2, 0.8) * w, rng.uniform(0.15, 0.35) * d)
            rise = rng.uniform(1.0, 2.6)
            parts.append(
                self._local_box(plot, centre, tuple(size), (top - PARAPET_M - 0.2, top + rise), roof)
            )
        if not tower and rng.random() < 0.45:
            parts.append(self._awning(plot, base + ground_m - 0.55))
        return join(parts)

    def _block_facade(self, storey_m: float, ground_m: float, tower: bool) -> int:
        rng = self.rng
        if tower and rng.random() < 0.5:
            rgb = _choose(rng, _CURTAIN)
            return self._facade(rgb, storey_m, rng.uniform(1.6, 2.4), (0.88, 0.78), ground_m, False)
        brick = rng.random() < 0.35
        rgb = _choose(rng, _BRICK if brick else _PLASTER + _CONCRETE)
        share = (float(rng.uniform(0.38, 0.62)), float(rng.uniform(0.48, 0.62)))
        return self._facade(rgb, storey_m, float(rng.uniform(2.4, 3.8)), share, ground_m, brick)

    def _facade(
        self,
        rgb: tuple[float, float, float],
        storey_m: float,
        bay_m: float,
        window_share: tuple[float, float],
        ground_m: float,
        brick: bool,
    ) -> int:
        params = (storey_m, bay_m, *window_share, ground_m, float(brick))
        return self.table.add(Look(Surface.BUILDING, Texture.FACADE, rgb, 0.45, params=params))

    @staticmethod
    def _walls(ring: Float[np.ndarray, "N 2"], base: float, top: float, look: int) -> Mesh:
        """Walls that reach into the ground; the façade's v starts at the base."""
        mesh = walls(ring, base - FOUNDATION_M, top, look)
        mesh.uvw[..., 1] -= FOUNDATION_M
        return mesh

    @staticmethod
    def _local_box(
        plot: Plot,
        centre: tuple[float, float],
        size: tuple[float, ...],
        z: tuple[float, float],
        look: int,
    ) -> Mesh:
        (x, y), (a, b) = centre, (0.5 * size[0], 0.5 * size[1])
        mesh = box((x - a, y - b, z[0]), (x + a, y + b, z[1]), look)
        T = np.eye(4)
        T[:2, 0], T[:2, 1], T[:2, 3] = plot.along, plot.into, plot.corner
        moved = mesh.transformed(T)
        return Mesh(moved.xyz, np.zeros_like(moved.uvw), moved.look)

    def _awning(self, plot: Plot, z: float) -> Mesh:
        rng = self.rng
        look = self.table.add(Look(Surface.BUILDING, Texture.PLAIN, _choose(rng, _AWNINGS), 0.4))
        start, width = rng.uniform(0.1, 0.3) * plot.width_m, rng.uniform(0.3, 0.6) * plot.width_m
        reach, thick = 1.0, 0.08
        low, high = z - 0.45, z

        def at(x: float, y: float, height: float) -> list[float]:
            return [*plot.world(np.array([x, y])), height]

        ends = (start, start + width)
        bottom = [at(ends[0], -reach, low - thick), at(ends[1], -reach, low - thick)]
        bottom += [at(ends[1], 0.0, high - thick), at(ends[0], 0.0, high - thick)]
        top = [
            at(ends[0], -reach, low),
            at(ends[1], -reach, low),
            at(ends[1], 0.0, high),
            at(ends[0], 0.0, high),
        ]
        return hexahedron(bottom, top, [look] * 6)


def _choose(
    rng: np.random.Generator, options: tuple[tuple[float, float, float], ...]
) -> tuple[float, float, float]:
    return options[int(rng.integers(len(options)))]
