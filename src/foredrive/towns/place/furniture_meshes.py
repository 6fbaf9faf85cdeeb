"""Meshes of street furniture.

Units are metres; x points along the traffic, the road lies to the left, and objects stand on z = 0.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foredrive.towns.place.materials import RETROREFLECTIVE, Material, MaterialTable, Surface, Texture
from foredrive.towns.place.mesh import Mesh, box, boxes, frustum, join, quads
from foredrive.towns.place.props import POLE_SAMPLE_M

SINK_M = 0.3
"""Depth to which standing objects reach into the ground, m."""
RAIL_STEP_M, RAIL_LOW_M, RAIL_HIGH_M = 4.0, 0.45, 0.75
BARRIER_HEIGHT_M = 3.2


@dataclass(frozen=True)
class FurnitureItem:
    """A piece of furniture that is ready to be placed."""

    mesh: Mesh
    room_m: tuple[float, float]
    """Half of the space that it needs along and across the road, m."""
    thin: tuple[tuple[Surface, Float[np.ndarray, "_ 3"]], ...] = ()
    """Points on parts that are thinner than the grid of vertical rays from which occupancy is computed."""


@dataclass
class FurnitureMaterials:
    """Numbers of the materials of furniture."""

    table: MaterialTable

    def __post_init__(self) -> None:
        def add(
            surface: Surface, rgb: tuple[float, float, float], reflectivity: float, gloss: float = 0.0
        ) -> int:
            return self.table.add(Material(surface, Texture.PLAIN, rgb, reflectivity, gloss))

        self.wood = add(Surface.STRUCTURE, (0.46, 0.32, 0.20), 0.4)
        self.iron = add(Surface.STRUCTURE, (0.14, 0.15, 0.16), 0.25)
        self.steel = add(Surface.STRUCTURE, (0.62, 0.63, 0.64), 0.6, 0.05)
        self.red = add(Surface.STRUCTURE, (0.68, 0.10, 0.08), 0.5)
        self.yellow = add(Surface.STRUCTURE, (0.85, 0.62, 0.06), 0.6)
        self.blue = add(Surface.STRUCTURE, (0.08, 0.20, 0.45), 0.4)
        self.green = add(Surface.STRUCTURE, (0.10, 0.26, 0.16), 0.35)
        self.white = add(Surface.STRUCTURE, (0.88, 0.88, 0.87), 0.8)
        self.orange = add(Surface.STRUCTURE, (0.95, 0.35, 0.08), 0.8)
        self.earth = add(Surface.TERRAIN, (0.40, 0.31, 0.22), 0.35)
        glass = Material(Surface.STRUCTURE, Texture.GLASS, (0.05, 0.06, 0.07), 0.1, 0.05)
        self.glass = self.table.add(glass)
        panel = Material(Surface.STRUCTURE, Texture.SLABS, (0.60, 0.60, 0.56), 0.4, params=(2.0,))
        self.panel = self.table.add(panel)
        self.pole = add(Surface.POLE, (0.42, 0.43, 0.44), 0.45, 0.03)
        self.mast = self.table.add(
            Material(Surface.POLE, Texture.PLAIN, (0.33, 0.26, 0.20), 0.3, params=(1.5,))
        )
        self.wire = add(Surface.POLE, (0.08, 0.08, 0.08), 0.15)
        self.sign_white = add(Surface.SIGN, (0.92, 0.92, 0.92), RETROREFLECTIVE)
        self.sign_red = add(Surface.SIGN, (0.75, 0.09, 0.09), RETROREFLECTIVE)
        self.sign_blue = add(Surface.SIGN, (0.06, 0.20, 0.52), RETROREFLECTIVE)
        self.sign_green = add(Surface.SIGN, (0.05, 0.32, 0.18), RETROREFLECTIVE)
        self.sign_black = add(Surface.SIGN, (0.07, 0.07, 0.07), 0.3)
        posters = ((0.75, 0.22, 0.20), (0.18, 0.42, 0.66), (0.90, 0.80, 0.45), (0.86, 0.86, 0.84))
        self.posters = [add(Surface.SIGN, rgb, 0.5) for rgb in posters]


def upright(x: float, y: float, height: float) -> Float[np.ndarray, "n 3"]:
    """Return points up a post."""
    z = np.arange(0.0, height, POLE_SAMPLE_M)
    return np.column_stack([np.full_like(z, x), np.full_like(z, y), z])


def plate(x: float, y: tuple[float, float], z: tuple[float, float]) -> Float[np.ndarray, "n 3"]:
    """Return points on a plate that stands across the road's direction."""
    ys, zs = (np.linspace(*span, int(np.ptp(span) / POLE_SAMPLE_M) + 2) for span in (y, z))
    grid_y, grid_z = np.meshgrid(ys, zs)
    return np.column_stack([np.full(grid_y.size, x), grid_y.ravel(), grid_z.ravel()])


def furniture_items(mats: FurnitureMaterials) -> dict[str, FurnitureItem]:
    """Return all furniture that consists of one piece."""
    return {
        "bench": _bench(mats),
        "bin": FurnitureItem(_post((0.22, 0.26), 0.9, mats.green, mats.iron), (0.4, 0.4)),
        "hydrant": _hydrant(mats),
        "mail_box": _mail_box(mats),
        "parking_meter": _parking_meter(mats),
        "bollards": _bollards(mats),
        "shelter": _shelter(mats),
        "cabinet": FurnitureItem(box((-0.5, -0.22, -SINK_M), (0.5, 0.22, 1.15), mats.white), (0.7, 0.45)),
        "speed_sign": _round_sign(mats),
        "information_sign": _board(mats, mats.sign_blue, (-0.4, 0.4), (1.6, 2.4), (0.0,)),
        "direction_sign": _board(mats, mats.sign_green, (-1.8, 1.8), (1.8, 3.8), (-1.2, 1.2)),
        "power_pole": _power_pole(mats),
        "billboard": _billboard(mats),
        "building_site": _building_site(mats),
    }


def _post(radii: tuple[float, float], height: float, material: int, lid: int) -> Mesh:
    parts = [frustum((0, 0, -SINK_M), (0, 0, height), radii, 8, material)]
    return join([*parts, frustum((0, 0, height), (0, 0, height + 0.06), (radii[1] + 0.03, 0.1), 8, lid)])


def _bench(mats: FurnitureMaterials) -> FurnitureItem:
    parts = [box((-0.9, y - 0.06, 0.42), (0.9, y + 0.06, 0.47), mats.wood) for y in (-0.15, 0.0, 0.15)]
    parts += [box((-0.9, -0.28, z), (0.9, -0.24, z + 0.12), mats.wood) for z in (0.6, 0.78)]
    for x in (-0.7, 0.65):
        parts.append(box((x, -0.2, -SINK_M), (x + 0.06, 0.2, 0.42), mats.iron))
        parts.append(box((x, -0.24, 0.4), (x + 0.06, -0.19, 0.92), mats.iron))
    return FurnitureItem(join(parts), (1.0, 0.5))


def _hydrant(mats: FurnitureMaterials) -> FurnitureItem:
    parts = [
        frustum((0, 0, -SINK_M), (0, 0, 0.6), (0.13, 0.11), 8, mats.red),
        frustum((0, 0, 0.6), (0, 0, 0.78), (0.13, 0.04), 8, mats.red),
        frustum((0, -0.2, 0.45), (0, 0.2, 0.45), (0.06, 0.06), 6, mats.yellow),
    ]
    return FurnitureItem(join(parts), (0.35, 0.35))


def _mail_box(mats: FurnitureMaterials) -> FurnitureItem:
    parts = [box((-0.25, -0.2, 0.12), (0.25, 0.2, 1.1), mats.blue)]
    parts += [box((-0.2, -0.15, -SINK_M), (0.2, 0.15, 0.12), mats.iron)]
    parts += [frustum((-0.25, 0, 1.08), (0.25, 0, 1.08), (0.2, 0.2), 10, mats.blue)]
    return FurnitureItem(join([*parts, box((-0.18, 0.19, 0.9), (0.18, 0.21, 0.97), mats.white)]), (0.45, 0.4))


def _parking_meter(mats: FurnitureMaterials) -> FurnitureItem:
    parts = [frustum((0, 0, -SINK_M), (0, 0, 1.0), (0.03, 0.03), 6, mats.pole)]
    parts += [box((-0.1, -0.07, 1.0), (0.1, 0.07, 1.35), mats.iron)]
    return FurnitureItem(join(parts), (0.3, 0.3), ((Surface.POLE, upright(0.0, 0.0, 1.3)),))


def _bollards(mats: FurnitureMaterials) -> FurnitureItem:
    parts, points = [], []
    for x in (-1.5, 0.0, 1.5):
        parts.append(frustum((x, 0, -SINK_M), (x, 0, 0.85), (0.08, 0.08), 8, mats.iron))
        parts.append(frustum((x, 0, 0.68), (x, 0, 0.78), (0.084, 0.084), 8, mats.white))
        points.append(upright(x, 0.0, 0.85))
    return FurnitureItem(join(parts), (1.8, 0.3), ((Surface.STRUCTURE, np.concatenate(points)),))


def _shelter(mats: FurnitureMaterials) -> FurnitureItem:
    """Build a bus shelter that is open to the road, with a seat, a poster and the sign of the stop."""
    parts = [
        box((-2.0, -0.75, 2.35), (2.0, 0.75, 2.5), mats.steel),
        box((-1.9, -0.68, 0.25), (1.9, -0.64, 2.2), mats.glass),
        box((-1.92, -0.6, 0.15), (-1.86, 0.35, 2.2), mats.posters[0]),
        box((-1.2, -0.6, 0.42), (1.4, -0.25, 0.48), mats.wood),
        box((2.6, 0.28, 2.1), (2.64, 0.68, 2.7), mats.sign_blue),
        frustum((2.62, 0.48, -SINK_M), (2.62, 0.48, 2.7), (0.03, 0.03), 6, mats.pole),
    ]
    for x in (-1.95, 1.89):
        for y in (-0.7, 0.6):
            parts.append(box((x, y, -SINK_M), (x + 0.06, y + 0.06, 2.4), mats.iron))
    sign = (Surface.SIGN, plate(2.62, (0.28, 0.68), (2.1, 2.7)))
    advert = (Surface.SIGN, plate(-1.89, (-0.6, 0.35), (0.15, 2.2)))
    return FurnitureItem(join(parts), (2.9, 0.85), (sign, advert, (Surface.POLE, upright(2.62, 0.48, 2.1))))


def _round_sign(mats: FurnitureMaterials) -> FurnitureItem:
    z = 2.2
    parts = [
        frustum((0, 0, -SINK_M), (0, 0, z + 0.2), (0.035, 0.035), 6, mats.pole),
        frustum((-0.04, 0, z), (-0.06, 0, z), (0.36, 0.36), 16, mats.sign_red),
        frustum((-0.06, 0, z), (-0.065, 0, z), (0.28, 0.28), 16, mats.sign_white),
    ]
    for y in (-0.1, 0.1):
        parts.append(box((-0.07, y - 0.06, z - 0.13), (-0.06, y + 0.06, z + 0.13), mats.sign_black))
        parts.append(box((-0.072, y - 0.02, z - 0.09), (-0.069, y + 0.025, z + 0.09), mats.sign_white))
    sign = (Surface.SIGN, plate(-0.05, (-0.25, 0.25), (z - 0.25, z + 0.25)))
    return FurnitureItem(join(parts), (0.3, 0.45), ((Surface.POLE, upright(0.0, 0.0, z)), sign))


def _board(
    mats: FurnitureMaterials,
    material: int,
    y: tuple[float, float],
    z: tuple[float, float],
    posts: tuple[float, ...],
) -> FurnitureItem:
    """Build a sign with lines of text that faces the traffic."""
    parts = [box((-0.07, y[0], z[0]), (-0.04, y[1], z[1]), material)]
    # Lines of text: white bars on the sign, which faces against x
    lines = max(1, int(np.ptp(z) / 0.5))
    step, wide = np.ptp(z) / lines, np.ptp(y)
    for k in range(lines):
        low = z[0] + (k + 0.3) * step
        left = y[1] - (0.1 + 0.12 * (k % 2)) * wide
        parts.append(
            box(
                (-0.075, left - (0.45 + 0.1 * k) * wide, low),
                (-0.065, left, low + 0.4 * step),
                mats.sign_white,
            )
        )
    thin = [(Surface.SIGN, plate(-0.05, y, z))]
    for post_m in posts:
        parts.append(frustum((0, post_m, -SINK_M), (0, post_m, z[1]), (0.05, 0.05), 6, mats.pole))
        thin.append((Surface.POLE, upright(0.0, post_m, z[0])))
    return FurnitureItem(join(parts), (0.4, 0.5 * wide + 0.1), tuple(thin))


POWER_POLE_M, CROSSARM_M, WIRE_M = 9.0, 1.1, 0.025


def _power_pole(mats: FurnitureMaterials) -> FurnitureItem:
    arm = POWER_POLE_M - 0.5
    parts = [
        frustum((0, 0, -SINK_M), (0, 0, POWER_POLE_M), (0.16, 0.11), 7, mats.mast),
        box((-0.06, -CROSSARM_M - 0.1, arm), (0.06, CROSSARM_M + 0.1, arm + 0.12), mats.mast),
    ]
    for y in (-CROSSARM_M, 0.0, CROSSARM_M):
        parts.append(frustum((0, y, arm + 0.12), (0, y, arm + 0.3), (0.05, 0.04), 6, mats.white))
    return FurnitureItem(join(parts), (0.4, 0.4), ((Surface.POLE, upright(0.0, 0.0, POWER_POLE_M)),))


def wires(start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], material: int) -> Mesh:
    """Build three sagging wires between the cross-arms of two poles with the given feet."""
    ahead = (end - start)[:2] / np.linalg.norm((end - start)[:2])
    left = np.array([-ahead[1], ahead[0], 0.0])
    share = np.linspace(0.0, 1.0, 5)[:, None]
    parts = []
    for y in (-CROSSARM_M, 0.0, CROSSARM_M):
        line = start + share * (end - start) + y * left
        # A parabola hangs 0.8 m below the straight line in the middle
        line[:, 2] += POWER_POLE_M - 0.2 - 3.2 * (share * (1.0 - share))[:, 0]
        # A wire is a triangular tube
        edges = [line + WIRE_M * side for side in (left, np.array([0.0, 0.0, 1.0]), -left)]
        for a, b in zip(edges, edges[1:] + edges[:1], strict=True):
            parts.append(quads(np.stack([b[:-1], b[1:], a[1:], a[:-1]], axis=1), material))
    return join(parts)


def _billboard(mats: FurnitureMaterials) -> FurnitureItem:
    y, z = (-3.0, 3.0), (2.6, 5.6)
    a, b, c, d = mats.posters
    parts = [
        box((-0.12, y[0], z[0]), (0.06, y[1], z[1]), mats.steel),
        *(box((0.05, y[0], h), (0.11, y[1], h + 0.1), mats.pole) for h in (z[0] + 0.3, 4.05, z[1] - 0.4)),
        box((-0.14, y[0] + 0.12, z[0] + 0.12), (-0.11, y[1] - 0.12, z[1] - 0.12), d),
        box((-0.15, 0.4, z[0] + 0.12), (-0.13, y[1] - 0.12, z[1] - 0.12), b),
        box((-0.15, y[0] + 0.5, z[0] + 0.5), (-0.13, 0.0, z[0] + 1.0), a),
        box((-0.16, 1.0, z[0] + 0.7), (-0.14, 2.2, z[0] + 2.0), c),
    ]
    thin: list[tuple[Surface, Float[np.ndarray, "_ 3"]]] = [(Surface.SIGN, plate(0.0, y, z))]
    for post_m in (-1.8, 1.8):
        parts.append(frustum((0.05, post_m, -2 * SINK_M), (0.05, post_m, z[1]), (0.14, 0.12), 8, mats.pole))
        thin.append((Surface.POLE, upright(0.05, post_m, z[0])))
    return FurnitureItem(join(parts), (0.5, 3.2), tuple(thin))


def _building_site(mats: FurnitureMaterials) -> FurnitureItem:
    """Build a building site: a heap of earth and a container behind striped barriers and cones."""
    parts = [
        frustum((1.6, -0.3, -0.2), (1.6, -0.3, 1.1), (1.5, 0.3), 9, mats.earth),
        box((-4.2, -1.2, -SINK_M), (-1.6, 1.0, 2.3), mats.yellow),
        box((-1.62, -0.9, 0.1), (-1.58, -0.1, 2.0), mats.iron),
    ]
    for k, x in enumerate(np.arange(-4.2, 4.0, 0.5)):
        parts.append(box((x, 1.55, 0.75), (x + 0.5, 1.6, 1.0), mats.white if k % 2 else mats.red))
        if k % 4 == 0:
            parts.append(box((x, 1.5, -SINK_M), (x + 0.08, 1.65, 1.05), mats.orange))
    for x, y in ((4.3, 1.4), (4.4, 0.2), (4.2, -1.0), (-4.6, 1.4)):
        parts.append(box((x - 0.2, y - 0.2, -0.1), (x + 0.2, y + 0.2, 0.05), mats.iron))
        parts.append(frustum((x, y, 0.05), (x, y, 0.35), (0.15, 0.1), 8, mats.orange))
        parts.append(frustum((x, y, 0.35), (x, y, 0.5), (0.1, 0.075), 8, mats.white))
        parts.append(frustum((x, y, 0.5), (x, y, 0.75), (0.075, 0.03), 8, mats.orange))
    return FurnitureItem(join(parts), (4.9, 1.8))


def guard_rail(feet: Float[np.ndarray, "N 3"], mats: FurnitureMaterials) -> Mesh:
    """Build a guard rail on posts along a line with the road on its left."""
    left = _left_of(feet)
    half = np.array([0.06, 0.05, 0.0])
    low, high = _raised(feet, -SINK_M), _raised(feet, RAIL_HIGH_M)
    parts = [boxes(low - half, high + half, mats.steel)]
    front, back = feet + 0.13 * left, feet + 0.05 * left
    middle = 0.5 * (RAIL_LOW_M + RAIL_HIGH_M)
    # Profile of the rail: two ridges towards the road and a groove between them
    lines = [
        _raised(front, RAIL_LOW_M),
        _raised(back, middle),
        _raised(front, RAIL_HIGH_M),
        _raised(back - 0.02 * left, RAIL_HIGH_M),
        _raised(back - 0.02 * left, RAIL_LOW_M),
    ]
    # The tube between neighbouring profiles
    for a, b in zip(lines, lines[1:] + lines[:1], strict=True):
        parts.append(quads(np.stack([b[:-1], b[1:], a[1:], a[:-1]], axis=1), mats.steel))
    return join(parts)


def sound_barrier(feet: Float[np.ndarray, "N 3"], mats: FurnitureMaterials) -> Mesh:
    """Build a wall of panels along a line with the road on its left."""
    left = _left_of(feet)
    low, high = _raised(feet, -SINK_M), _raised(feet, BARRIER_HEIGHT_M)
    parts = []
    # Rectangle of panels, 0.14 m thick
    lines = [low + 0.07 * left, high + 0.07 * left, high - 0.07 * left, low - 0.07 * left]
    for a, b in zip(lines, lines[1:] + lines[:1], strict=True):
        parts.append(quads(np.stack([b[:-1], b[1:], a[1:], a[:-1]], axis=1), mats.panel))
    half = np.array([0.1, 0.12, 0.0])
    return join([*parts, boxes(low - half, high + half, mats.steel)])


def _raised(line: Float[np.ndarray, "N 3"], height: float) -> Float[np.ndarray, "N 3"]:
    return line + np.array([0.0, 0.0, height])


def _left_of(line: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    step = np.gradient(line[:, :2], axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True).clip(1e-9)
    return np.column_stack([-step[:, 1], step[:, 0], np.zeros(len(line))])
