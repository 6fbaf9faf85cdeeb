"""Free sites for objects: off the roads and clear of each other."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import shapely
from jaxtyping import Bool, Float

from foredrive.towns.map.ground_plan import GroundPlan
from foredrive.towns.place.terrain import Terrain

GRID_M = 20.0


@dataclass
class Site:
    """A town's free land and the objects on it."""

    plan: GroundPlan
    terrain: Terrain
    taken: list[shapely.Geometry] = field(default_factory=list)
    _cells: dict[tuple[int, int], list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._paved = self.plan.covered
        shapely.prepare(self._paved)

    def is_free(self, area: shapely.Geometry) -> bool:
        """Return whether an area touches no road, walkway, bridge or object."""
        if self._paved.intersects(area):
            return False
        return not any(other.intersects(area) for other in self.near(area))

    def near(self, area: shapely.Geometry) -> list[shapely.Geometry]:
        """Return the areas that are taken near an area."""
        # A hash grid: only areas in the same cells can touch
        indices = {i for cell in self._cells_of(area) for i in self._cells.get(cell, ())}
        return [self.taken[i] for i in sorted(indices)]

    def take(self, area: shapely.Geometry) -> None:
        """Mark an area as taken."""
        for cell in self._cells_of(area):
            self._cells.setdefault(cell, []).append(len(self.taken))
        self.taken.append(area)

    def distance_to_road(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the distance of points to the nearest paved area, m."""
        return shapely.distance(self._paved, shapely.points(xy))

    def height(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the height of the land: the walkway where there is one, the terrain elsewhere."""
        return np.where(self._on_ground(xy), self.plan.borders.top(xy), self.terrain.height(xy))

    def _on_ground(self, xy: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        return shapely.contains_xy(self.plan.ground, xy[:, 0], xy[:, 1])

    @staticmethod
    def _cells_of(area: shapely.Geometry) -> Iterator[tuple[int, int]]:
        # Cells that the bounding box covers
        x0, y0, x1, y1 = (int(c // GRID_M) for c in area.bounds)
        return ((x, y) for x in range(x0, x1 + 1) for y in range(y0, y1 + 1))


@dataclass(frozen=True)
class Frontage:
    """A line along the roads at some distance, with the road on its left."""

    line: shapely.LineString
    walkway: bool
    """Whether a walkway runs along the line."""

    def at(self, along_m: float) -> Float[np.ndarray, "2"]:
        """Return the point at an arc length."""
        return shapely.get_coordinates(shapely.line_interpolate_point(self.line, along_m))[0]


def frontages(plan: GroundPlan, setback_m: float) -> list[Frontage]:
    """Return lines at a distance from all pavement on the ground, in a fixed order."""
    walkways = shapely.union_all([p.area for p in plan.pieces if p.raise_m > 0]).buffer(setback_m + 1.0)
    shapely.prepare(walkways)
    rings = []
    # Rings around all pavement; oriented, so that the road is on the left
    for polygon in shapely.get_parts(shapely.orient_polygons(plan.ground.buffer(setback_m).simplify(0.1))):
        rings += [polygon.exterior, *polygon.interiors]
    lines = []
    for ring in rings:
        # A line counts as along a walkway if most of its points are
        segments = shapely.segmentize(ring, 5.0)
        beside = shapely.contains_xy(walkways, shapely.get_coordinates(segments))
        lines.append(Frontage(shapely.LineString(segments.coords), bool(beside.mean() > 0.5)))
    return sorted(lines, key=lambda f: f.line.bounds)
