"""Meshes of buildings: houses, blocks, towers, halls and barns, each on its plot."""

from dataclasses import dataclass, field

import numpy as np
import shapely
from jaxtyping import Float

from foredrive.towns.place.assets import Assets, Rgb
from foredrive.towns.place.materials import (
    GroundFloor,
    Material,
    MaterialTable,
    Surface,
    Texture,
    WallKind,
    WindowKind,
)
from foredrive.towns.place.mesh import (
    Mesh,
    Vector,
    box,
    boxes,
    frustum,
    hexahedron,
    join,
    polygon_cap,
    prism,
    quads,
    triangles,
)
from foredrive.towns.place.plot import Plot
from foredrive.towns.place.styles import Style

EAVES_M = 0.45


def gable_roof(plot: Plot, eaves: float, ridge: float, roof: int, wall: int) -> Mesh:
    """Build two slopes of material `roof` that extend beyond the eaves, and gables of material `wall`."""
    w, d, e = plot.width_m, plot.depth_m, EAVES_M
    # The slope goes on beyond the eaves, so its lower edge lies below them
    drop = (ridge - eaves) / (0.5 * d) * e
    slopes = []
    for y0, x0, x1 in ((-e, -e, w + e), (d + e, w + e, -e)):
        # From the lower edge at the eaves up to the ridge: seen from outside, counter-clockwise
        corners = [[x0, y0, eaves - drop], [x1, y0, eaves - drop]]
        corners += [[x1, 0.5 * d, ridge], [x0, 0.5 * d, ridge]]
        run = float(np.hypot(0.5 * d + e, ridge - eaves + drop))
        # Texture: u along the eaves, v up the slope
        uvw = np.array([[[0, 0, 0], [w, 0, 0], [w, run, 0], [0, run, 0]]], float)
        top = np.array([corners])
        # The underside is the same quad with reversed corners, a little lower
        slopes += [quads(top, roof, uvw), quads(top[:, ::-1] - [0.0, 0.0, 0.15], roof, uvw)]
    peak = ridge - 0.1
    gables = np.array(
        [
            [[w, 0.0, eaves], [w, d, eaves], [w, 0.5 * d, peak]],
            [[0.0, d, eaves], [0.0, 0.0, eaves], [0.0, 0.5 * d, peak]],
        ]
    )
    # Without u and w a façade has no windows.
    return plot.placed(join([*slopes, triangles(gables, wall, np.zeros((2, 3, 3)))]))


def hip_roof(plot: Plot, eaves: float, ridge: float, roof: int) -> Mesh:
    """Build four slopes on a plot that is wider than deep."""
    w, d, e = plot.width_m, plot.depth_m, EAVES_M
    a, b, c, f = [-e, -e, eaves], [w + e, -e, eaves], [w + e, d + e, eaves], [-e, d + e, eaves]
    # The ridge is shorter than the house by half its depth at both ends, so that all slopes have one pitch
    p, q = [0.5 * d, 0.5 * d, ridge], [w - 0.5 * d, 0.5 * d, ridge]
    run = float(np.hypot(0.5 * d + e, ridge - eaves))
    parts = [quads(np.array([[f, c, b, a]], float), roof)]
    for corners in ([a, b, q, p], [c, f, p, q]):
        uvw = np.array([[[0, 0, 0], [w, 0, 0], [w - 0.5 * d, run, 0], [0.5 * d, run, 0]]], float)
        parts.append(quads(np.array([corners], float), roof, uvw))
    for triangle in ([b, c, q], [f, a, p]):
        uvw = np.array([[[0, 0, 0], [d, 0, 0], [0.5 * d, run, 0]]], float)
        parts.append(triangles(np.array([triangle], float), roof, uvw))
    return plot.placed(join(parts))


PARAPET_M = 0.5
CORNER_M = 0.4
"""Width without windows at either end of a wall, m."""
FENCE_M, HEDGE_M = 1.0, 1.2
BALCONY_M = 1.15


@dataclass(frozen=True)
class _Facade:
    """The properties of a façade's material that attached parts need."""

    material: int
    storey_m: float
    bay_m: float
    ground_m: float

    def centres(self, width_m: float) -> Float[np.ndarray, "n"]:
        """Return the positions of the middles of a wall's bays, m, as in the texture."""
        # Windows keep clear of the corners; the same formula as in the texture, so that balconies fit
        usable = width_m - 2 * CORNER_M
        count = max(1, int(usable / self.bay_m + 0.3))
        return CORNER_M + (np.arange(count) + 0.5) * usable / count


@dataclass
class BuildingMaker:
    """A maker of building meshes in the style of a town, from the town's assets."""

    table: MaterialTable
    rng: np.random.Generator
    assets: Assets
    style: Style
    _hedge: int = field(init=False)
    _wood: int = field(init=False)
    _metal: int = field(init=False)

    def __post_init__(self) -> None:
        hedge = Material(Surface.VEGETATION, Texture.FOLIAGE, self.assets.leaves[-1], 0.5)
        self._hedge = self.table.add(hedge)
        wood = Material(Surface.STRUCTURE, Texture.PLAIN, (0.62, 0.56, 0.48), 0.4, params=(1.5,))
        self._wood = self.table.add(wood)
        self._metal = self.table.add(Material(Surface.BUILDING, Texture.PLAIN, (0.20, 0.21, 0.22), 0.3))

    def build(self, kind: str, plot: Plot, base: float, detail: bool) -> Mesh:
        """Build the mesh of a building.

        Args:
            kind: "house", "block", "tower", "hall" or "barn".
            base: height of the ground, m.
            detail: whether it stands in the first row, and so has balconies, cornices and similar parts.
        """
        if kind == "house":
            return self._house(plot, base)
        if kind == "hall":
            return self._hall(plot, base)
        if kind == "barn":
            return self._barn(plot, base)
        return self._block(plot, base, kind == "tower", detail)

    def border(self, kind: str, plot: Plot, ends: Float[np.ndarray, "2 2"], base: float) -> Mesh:
        """Build a hedge or a fence between two local points with the same y."""
        (x0, y), (x1, _) = ends
        if kind == "hedge":
            ends_z = base - 0.4, base + HEDGE_M
            return plot.box((0.5 * (x0 + x1), y), (x1 - x0, 0.5), ends_z, self._hedge)
        parts = [
            box((x0, y - 0.02, base + z), (x1, y + 0.02, base + z + 0.1), self._wood) for z in (0.25, 0.75)
        ]
        # Pickets every 0.3 m; every sixth is a stronger post
        x = np.arange(x0, x1, 0.3)
        post = np.arange(len(x)) % 6 == 0
        half, top = np.where(post, 0.06, 0.045), base + np.where(post, FENCE_M + 0.1, FENCE_M)
        low = np.column_stack([x - half, np.full_like(x, y - 0.05), np.full_like(x, base - 0.3)])
        high = np.column_stack([x + half, np.full_like(x, y - 0.02), top])
        parts.append(boxes(low, high, self._wood))
        return plot.placed(join(parts))

    def _choose(self, options: tuple[Rgb, ...]) -> Rgb:
        return options[int(self.rng.integers(len(options)))]

    def _plain(self, rgb: Rgb, reflectivity: float, texture: Texture = Texture.PLAIN) -> int:
        return self.table.add(Material(Surface.BUILDING, texture, rgb, reflectivity, params=(1.0,)))

    def _facade(
        self,
        wall: tuple[WallKind, Rgb],
        windows: WindowKind,
        ground_floor: GroundFloor,
        storey_bay_ground_m: tuple[float, float, float],
        share: tuple[float, float],
    ) -> _Facade:
        storey, bay, ground = storey_bay_ground_m
        accent = self.assets.accents[int(self.rng.integers(len(self.assets.accents)))]
        # Materials are shared by number: equal parameters give the same material
        kinds = (float(wall[0]), float(windows), float(ground_floor), float(accent))
        params = (storey, bay, *share, ground, *kinds)
        reflectivity = 0.55 if wall[0] is WallKind.SHEET else 0.3 + 0.25 * float(np.mean(wall[1]))
        material = Material(Surface.BUILDING, Texture.FACADE, wall[1], reflectivity, params=params)
        return _Facade(self.table.add(material), storey, bay, ground)

    def _wall(self, *but: WallKind) -> tuple[WallKind, Rgb]:
        options = [wall for wall in self.assets.walls if wall[0] not in but]
        return options[int(self.rng.integers(len(options)))]

    def _house(self, plot: Plot, base: float) -> Mesh:
        """Build a house of one or two storeys with a gabled or hipped roof, a chimney and a porch."""
        rng = self.rng
        storeys, ground_m, storey_m = int(rng.integers(1, 3)), 2.9, 2.8
        facade = self._facade(
            self._wall(WallKind.STONE),
            # Walls first, then a roof: hipped on wide houses, else gabled
            self.assets.windows[0],
            GroundFloor.DOORS,
            (storey_m, 2.9, ground_m - 0.1),
            (0.42, 0.5),
        )
        roof = self._plain(self._choose(self.assets.roofs), 0.35, Texture.TILES)
        eaves = base + ground_m + (storeys - 1) * storey_m
        w, d = plot.width_m, plot.depth_m
        ridge = eaves + rng.uniform(0.5, 0.85) * 0.5 * d
        parts = [plot.walls([[0, 0], [w, 0], [w, d], [0, d]], base, eaves, facade.material)]
        if w > d + 1.0 and rng.random() < 0.35:
            parts.append(hip_roof(plot, eaves, ridge, roof))
        else:
            parts.append(gable_roof(plot, eaves, ridge, roof, facade.material))
        # A chimney through the roof
        if rng.random() < 0.6:
            x, y = rng.uniform(0.35, 0.6) * w, 0.5 * d + rng.uniform(0.3, 1.2)
            brick = self._plain((0.45, 0.30, 0.26), 0.35)
            parts.append(plot.box((x, y), (0.7, 0.7), (eaves, ridge + 0.9), brick))
        # A porch: roof, step and two posts
        if rng.random() < 0.5:
            x, wide = rng.uniform(0.3, 0.7) * w, rng.uniform(1.6, 3.0)
            parts.append(plot.box((x, -0.6), (wide, 1.4), (base + 2.55, base + 2.7), self._metal))
            parts.append(plot.box((x, -0.5), (wide, 1.1), (base - 0.5, base + 0.15), facade.material))
            for side in (-0.46, 0.46):
                post = (x + side * wide, -1.15)
                parts.append(plot.box(post, (0.12, 0.12), (base, base + 2.55), self._wood))
        return join(parts)

    def _barn(self, plot: Plot, base: float) -> Mesh:
        """Build a barn of a farm, often with a silo beside it."""
        rng, w, d = self.rng, plot.width_m, plot.depth_m
        rgb = self._choose(((0.45, 0.16, 0.13), (0.36, 0.28, 0.22), *self.assets.sheet[:1]))
        ground = float(rng.uniform(4.0, 5.5))
        wall = (WallKind.SHEET, rgb)
        facade = self._facade(wall, WindowKind.HALL, GroundFloor.GATES, (3.0, 5.0, ground), (0.2, 0.2))
        roof = self._plain(self._choose(self.assets.roofs), 0.4, Texture.TILES)
        eaves, ridge = base + ground, base + ground + rng.uniform(0.6, 0.9) * 0.5 * d
        parts = [
            plot.walls([[0, 0], [w, 0], [w, d], [0, d]], base, eaves, facade.material),
            gable_roof(plot, eaves, ridge, roof, facade.material),
        ]
        # A silo beside the barn: a cylinder with a conical roof
        if rng.random() < 0.6:
            steel = self._plain((0.70, 0.71, 0.72), 0.6)
            radius, top = rng.uniform(1.4, 2.0), base + rng.uniform(7.0, 11.0)
            x, y = w - radius - 0.3, d - radius + 0.2
            silo = [
                frustum((x, y, base - 1.0), (x, y, top), (radius, radius), 12, steel),
                frustum((x, y, top), (x, y, top + 0.8 * radius), (radius, 0.2), 12, steel),
            ]
            parts.append(plot.placed(join(silo)))
        return join(parts)

    def _hall(self, plot: Plot, base: float) -> Mesh:
        """Build a warehouse with roller doors, or a market with shop windows and a sign."""
        rng, w, d = self.rng, plot.width_m, plot.depth_m
        market = rng.random() < 0.4
        ground = float(rng.uniform(5.5, 9.0))
        wall = (WallKind.SHEET, self._choose(self.assets.sheet))
        if market:
            wall = self._wall(WallKind.BOARDS)
        floor = GroundFloor.SHOPS if market else GroundFloor.GATES
        glazed = 4.2 if market else ground
        facade = self._facade(wall, WindowKind.HALL, floor, (40.0, 5.5, glazed), (0.0, 0.0))
        roof = self._plain(self._choose(self.assets.flat_roofs), 0.3)
        top = base + ground + PARAPET_M
        ring: list[Vector] = [[0, 0], [w, 0], [w, d], [0, d]]
        parts = [
            plot.walls(ring, base, top, facade.material),
            polygon_cap(plot.polygon(), top - PARAPET_M, roof),
            *self._roof_boxes(plot, top - PARAPET_M, roof, int(rng.integers(2, 6))),
        ]
        if market or rng.random() < 0.4:
            x, wide = rng.uniform(0.3, 0.7) * w, rng.uniform(0.2, 0.35) * w
            sign = self._plain(self._choose(self.assets.awnings), 0.6)
            parts.append(plot.box((x, -0.15), (wide, 0.3), (top - 1.9, top + 0.3), sign))
        if market:
            z = base + 3.2
            parts.append(plot.box((0.5 * w, -0.9), (0.8 * w, 1.8), (z, z + 0.3), self._metal))
        return join(parts)

    def _block(self, plot: Plot, base: float, tower: bool, detail: bool) -> Mesh:
        """Build a block of several storeys with a flat roof. Some blocks have a notch in the back."""
        rng, w, d = self.rng, plot.width_m, plot.depth_m
        low, high = self.style.storeys
        storeys = int(rng.integers(8, 17) if tower else rng.integers(low, high + 1))
        facade, homes = self._block_facade(tower)
        roof = self._plain(self._choose(self.assets.flat_roofs), 0.3)
        top = base + facade.ground_m + (storeys - 1) * facade.storey_m + PARAPET_M
        outline: list[Vector] = [[0, 0], [w, 0], [w, d], [0, d]]
        # An L-shaped outline: a notch in the back left corner
        if w > 15.0 and rng.random() < 0.45:
            x, y = rng.uniform(0.35, 0.65) * w, rng.uniform(0.4, 0.6) * d
            outline = [[0, 0], [w, 0], [w, d], [x, d], [x, y], [0, y]]
        area = shapely.Polygon(plot.world(np.array(outline, float)))
        parts = [
            plot.walls(outline, base, top, facade.material),
            polygon_cap(area, top - PARAPET_M, roof),
            *self._roof_boxes(plot, top - PARAPET_M, roof, int(rng.integers(1, 4))),
        ]
        if not detail:
            return join(parts)
        # A cornice below the parapet or below the top storey
        if not tower and rng.random() < 0.5:
            ledge = self._plain((0.74, 0.72, 0.68), 0.4)
            rim = area.buffer(0.3, join_style="mitre")
            z = top - 0.35 if rng.random() < 0.7 else top - facade.storey_m - 0.3
            parts.append(prism(rim, z, z + 0.35, ledge, ledge))
        if homes and storeys > 2 and rng.random() < 0.55:
            parts += self._balconies(plot, base, storeys, facade)
        elif not tower and rng.random() < 0.6:
            parts.append(self._awning(plot, base + facade.ground_m - 1.0))
        return join(parts)

    def _block_facade(self, tower: bool) -> tuple[_Facade, bool]:
        """Return the façade, and whether people live behind it."""
        rng = self.rng
        storey, ground = float(rng.uniform(2.9, 3.4)), float(rng.uniform(3.6, 4.5))
        if rng.random() < (0.5 if tower else 0.08):
            wall = (WallKind.PLASTER, self._choose(self.assets.curtain))
            bay = float(rng.uniform(1.4, 2.4))
            return (
                self._facade(
                    wall, WindowKind.CURTAIN, GroundFloor.SHOPS, (storey + 0.4, bay, ground), (0.9, 0.74)
                ),
                False,
            )
        windows = self.assets.windows[int(rng.integers(len(self.assets.windows)))]
        share = (float(rng.uniform(0.36, 0.6)), float(rng.uniform(0.45, 0.6)))
        floor = GroundFloor.SHOPS if rng.random() < self.style.shops else GroundFloor.DOORS
        sizes = (storey, float(rng.uniform(2.4, 3.8)), ground)
        facade = self._facade(self._wall(), windows, floor, sizes, share)
        return facade, windows not in (WindowKind.RIBBON, WindowKind.SLIT, WindowKind.GRID)

    def _balconies(self, plot: Plot, base: float, storeys: int, facade: _Facade) -> list[Mesh]:
        """Build balconies, one above the other, in front of some of the bays."""
        rng = self.rng
        centres = facade.centres(plot.width_m)
        slab, rail = self._plain((0.70, 0.69, 0.66), 0.4), self._metal
        if rng.random() < 0.5:
            rail = self._plain(self._choose(self.assets.awnings), 0.4)
        half = 0.46 * facade.bay_m
        # Every second or third bay, from the first or second on
        some = centres[int(rng.integers(0, 2)) :: int(rng.integers(2, 4))]
        floors = base + facade.ground_m + np.arange(storeys - 1) * facade.storey_m
        # One balcony for each pair of chosen bay and storey
        x, z = (a.ravel() for a in np.meshgrid(some, floors))

        def part(x0: float, y0: float, z0: float, x1: float, y1: float, z1: float, material: int) -> Mesh:
            low, high = (
                np.column_stack([x + dx, np.full_like(x, y), z + dz])
                for dx, y, dz in ((x0, y0, z0), (x1, y1, z1))
            )
            return boxes(low, high, material)

        y = -BALCONY_M
        # Slab, front rail and two side rails
        parts = [
            part(-half, y, -0.1, half, 0.05, 0.08, slab),
            part(-half, y, 0.12, half, y + 0.05, 1.0, rail),
            part(-half, y + 0.05, 0.12, 0.05 - half, 0.05, 1.0, rail),
            part(half - 0.05, y + 0.05, 0.12, half, 0.05, 1.0, rail),
        ]
        return [plot.placed(join(parts))]

    def _roof_boxes(self, plot: Plot, z: float, material: int, count: int) -> list[Mesh]:
        """Build boxes on a flat roof for stairs, lifts and air conditioning."""
        rng = self.rng
        parts = []
        for _ in range(count):
            size = tuple(rng.uniform(1.5, 4.0, 2))
            centre = (rng.uniform(0.2, 0.8) * plot.width_m, rng.uniform(0.15, 0.35) * plot.depth_m)
            parts.append(plot.box(centre, size, (z - 0.2, z + rng.uniform(1.0, 2.6)), material))
        return parts

    def _awning(self, plot: Plot, z: float) -> Mesh:
        rng = self.rng
        material = self._plain(self._choose(self.assets.awnings), 0.4)
        start, width = rng.uniform(0.1, 0.3) * plot.width_m, rng.uniform(0.3, 0.6) * plot.width_m
        reach, thick, low = 1.0, 0.08, z - 0.45
        x0, x1 = start, start + width

        def slab(sink: float) -> list[list[float]]:
            return [
                [x0, -reach, low - sink],
                [x1, -reach, low - sink],
                [x1, 0.0, z - sink],
                [x0, 0.0, z - sink],
            ]

        return plot.placed(hexahedron(slab(thick), slab(0.0), [material] * 6))
