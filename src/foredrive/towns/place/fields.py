"""Farmland between the roads: crops in rows, meadows behind fences, and bales on stubble."""

import itertools
from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Float

from foredrive.towns.place.materials import Material, MaterialTable, Surface, Texture, srgb_to_linear
from foredrive.towns.place.mesh import Mesh, boxes, frustum, join
from foredrive.towns.place.props import POLE_SAMPLE_M, ThinPoints, pole_points, thin_points
from foredrive.towns.place.site import Site
from foredrive.towns.place.terrain import CELL_M, Field

PARCEL_M = (55.0, 130.0)
ROAD_SETBACK_M, CLEARANCE_M, HEDGE_M = 6.0, 4.0, 3.0
"""Distances of fields, m: from roads, from standing objects, and half the gap between two fields."""
MIN_AREA_M2, MIN_WIDTH_M = 700.0, 16.0
POST_STEP_M, POST_M, RAILS_M = 3.0, 1.15, (0.55, 1.0)
GATE_M = 6.0
BALES_PER_M2 = 1 / 350.0
BALE_M = (0.65, 1.2)
"""Radius and length of a bale, m."""

_CROPS = {
    "wheat": (0.24, (0.73, 0.61, 0.33), (0.60, 0.48, 0.28), 0.2, 0.14),
    "maize": (0.26, (0.26, 0.42, 0.15), (0.38, 0.29, 0.20), 0.75, 0.45),
    "ploughed": (0.16, (0.42, 0.32, 0.23), (0.29, 0.21, 0.15), 0.9, 0.5),
    "stubble": (0.16, (0.70, 0.61, 0.40), (0.52, 0.43, 0.29), 0.4, 0.2),
}
"""Share of the fields, colour of the crop, colour between its rows, distance and width of the rows (m)."""
_MEADOW = "meadow"


def lay_out_fields(site: Site, table: MaterialTable, rng: np.random.Generator) -> tuple[Field, ...]:
    """Lay out fields on the remaining land and take it from the site.

    Meadows have the same look as the land.
    """
    low = site.terrain.origin_xy + 4.0 * CELL_M
    high = site.terrain.origin_xy + CELL_M * (np.array(site.terrain.z.shape[::-1]) - 5.0)
    # Fields keep clear of all pavement
    paved = site.plan.covered.buffer(ROAD_SETBACK_M).simplify(1.0)
    shapely.prepare(paved)
    names, shares = [*_CROPS, _MEADOW], [crop[0] for crop in _CROPS.values()]
    fields = []
    for parcel in _parcels(low, high, rng):
        # What is left of a parcel after its hedge, the roads and all objects
        taken = [area.buffer(CLEARANCE_M) for area in site.near(parcel)]
        free = shapely.difference(parcel.buffer(-HEDGE_M), shapely.union_all([paved, *taken]))
        # Opening with half the minimum width removes narrow strips
        free = free.buffer(-0.5 * MIN_WIDTH_M).buffer(0.5 * MIN_WIDTH_M, join_style="mitre")
        for area in shapely.get_parts(free.intersection(parcel)):
            kind = str(rng.choice(names, p=[*shares, 1.0 - sum(shares)]))
            if area.area < MIN_AREA_M2:
                continue
            site.take(area)
            fields.append(Field(area.simplify(0.5), _direction(area), kind, _material(kind, table)))
    return tuple(fields)


def build_on_fields(
    fields: Sequence[Field], site: Site, table: MaterialTable, rng: np.random.Generator
) -> tuple[Mesh, ThinPoints]:
    """Build fences around meadows and bales on stubble."""
    wood = table.add(Material(Surface.STRUCTURE, Texture.PLAIN, (0.47, 0.40, 0.32), 0.4, params=(1.5,)))
    straw = table.add(Material(Surface.VEGETATION, Texture.PLAIN, (0.74, 0.63, 0.36), 0.5, params=(2.0,)))
    parts, points = [], []
    for field in fields:
        if field.kind == _MEADOW:
            mesh, thin = _fence(field.area, site, wood)
            parts.append(mesh)
            points.append(thin)
        elif field.kind == "stubble":
            parts += _bales(field, site, straw, rng)
    return join(parts), thin_points(points, Surface.STRUCTURE)


def _parcels(
    low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"], rng: np.random.Generator
) -> list[shapely.Polygon]:
    """Divide the land into columns, each of which is divided separately."""
    parcels, x = [], float(low[0])
    while x < high[0]:
        right = min(x + float(rng.uniform(*PARCEL_M)), float(high[0]))
        y = float(low[1])
        while y < high[1]:
            top = min(y + float(rng.uniform(*PARCEL_M)), float(high[1]))
            parcels.append(shapely.box(x, y, right, top))
            y = top
        x = right
    return parcels


def _direction(area: shapely.Polygon) -> Float[np.ndarray, "2"]:
    """Return the unit vector of ploughing: along the longer side of the rectangle around a field."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(area))
    sides = np.diff(corners[:3], axis=0)
    side = sides[np.linalg.norm(sides, axis=1).argmax()]
    return np.asarray(side / np.linalg.norm(side))


def _material(kind: str, table: MaterialTable) -> int | None:
    if kind == _MEADOW:
        return None
    _, crop, soil, step_m, row_m = _CROPS[kind]
    # The second colour of the texture is a parameter, so it must be linear already
    params = (step_m, row_m, *srgb_to_linear([soil])[0].tolist())
    return table.add(Material(Surface.TERRAIN, Texture.FIELD, crop, 0.45, params=params))


def _fence(area: shapely.Polygon, site: Site, material: int) -> tuple[Mesh, Float[np.ndarray, "n 3"]]:
    """Build posts and rails around a meadow, with an open gate. Also return points on them."""
    ring = area.exterior
    count = max(int((ring.length - GATE_M) / POST_STEP_M), 1)
    # Posts at equal distances around the ring, except for the gate at its start
    along = GATE_M + (ring.length - GATE_M) * np.arange(count + 1) / count
    xy = shapely.get_coordinates(shapely.line_interpolate_point(ring, along))
    feet = np.column_stack([xy, site.height(xy)])
    half = np.array([0.05, 0.05, 0.0])
    parts = [boxes(feet - half - [0.0, 0.0, 0.4], feet + half + [0.0, 0.0, POST_M], material)]
    points = [pole_points(foot[:2], foot[2], POST_M) for foot in feet]
    for a, b in itertools.pairwise(feet):
        # Rails between neighbouring posts; their points are thin structures for the labels
        steps = np.linspace(0.0, 1.0, int(np.linalg.norm(b - a) / POLE_SAMPLE_M) + 2)[:, None]
        for z in RAILS_M:
            up = np.array([0.0, 0.0, z])
            low, high = a + up, b + up
            parts.append(frustum(tuple(low), tuple(high), (0.05, 0.05), 4, material))
            points.append(low + steps * (high - low))
    return join(parts), np.concatenate(points)


def _bales(field: Field, site: Site, material: int, rng: np.random.Generator) -> list[Mesh]:
    """Build round bales at random places of a field."""
    x0, y0, x1, y1 = field.area.bounds
    xy = rng.uniform((x0, y0), (x1, y1), (int((x1 - x0) * (y1 - y0) * BALES_PER_M2), 2))
    inside = field.area.buffer(-2.0)
    xy = xy[shapely.contains_xy(inside, xy[:, 0], xy[:, 1])]
    radius, length = BALE_M
    parts = []
    for (x, y), z in zip(xy.tolist(), site.height(xy).tolist(), strict=True):
        # Bales lie on their round side, roughly along the rows
        angle = float(rng.normal(0.0, 0.4)) + float(np.arctan2(field.along[1], field.along[0]))
        ahead = 0.5 * length * np.array([np.cos(angle), np.sin(angle), 0.0])
        # They sink a little into the ground
        middle = np.array([x, y, z + 0.93 * radius])
        parts.append(frustum(tuple(middle - ahead), tuple(middle + ahead), (radius, radius), 14, material))
    return parts
