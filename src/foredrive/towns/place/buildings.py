"""Placement of buildings along the roads and behind them, generated from a seed."""

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

from foredrive.towns.place.assets import Assets
from foredrive.towns.place.building_meshes import BuildingMaker
from foredrive.towns.place.materials import MaterialTable
from foredrive.towns.place.mesh import Mesh, join
from foredrive.towns.place.plot import Plot
from foredrive.towns.place.site import Frontage, Site, frontages
from foredrive.towns.place.styles import Style, style_of

SETBACK_M = 3.0
CLEARANCE_M = 0.8
GARDEN_M = 2.2
"""Distance from a garden's fence to the line where the houses may begin, m."""
SKYLINE_TRIES_PER_M2 = 1 / 900.0
SKYLINE_MIN_M, SKYLINE_MAX_M = 16.0, 75.0

_WIDTH_M = {
    "house": (8.0, 13.0),
    "block": (11.0, 26.0),
    "tower": (16.0, 26.0),
    "hall": (22.0, 42.0),
    "barn": (12.0, 22.0),
}
_DEPTH_M = {
    "house": (8.0, 11.0),
    "block": (10.0, 15.0),
    "tower": (14.0, 22.0),
    "hall": (16.0, 26.0),
    "barn": (9.0, 13.0),
}


def build_buildings(
    site: Site, town_name: str, assets: Assets, table: MaterialTable, rng: np.random.Generator
) -> Mesh:
    """Build rows of buildings along the frontages, then a sparser second row.

    The plots are taken from the site.
    """
    style = style_of(town_name)
    builder = _Builder(site, rng, style, BuildingMaker(table, rng, assets, style))
    parts = []
    for frontage in frontages(site.plan, SETBACK_M):
        parts += builder.row(frontage)
    parts += builder.skyline()
    return join(parts)


@dataclass
class _Builder:
    site: Site
    rng: np.random.Generator
    style: Style
    maker: BuildingMaker

    def row(self, frontage: Frontage) -> list[Mesh]:
        """Build buildings side by side along one line."""
        rng, length = self.rng, frontage.line.length
        density = self.style.density if frontage.walkway else self.style.open_density
        # Walk along the line: skip gaps, and place a building wherever its plot is free
        parts, s = [], rng.uniform(0.0, 8.0)
        while s < length - 8.0:
            if rng.random() > density:
                s += rng.uniform(8.0, 22.0)
                continue
            kind = self._draw_kind()
            width, depth = self._draw_size(kind)
            # The road lies to the left of the line, so the plot's front
            # runs from b to a, with its left away from it
            a, b = frontage.at(s), frontage.at(min(s + width, length))
            back_m = 0.0 if frontage.walkway else rng.uniform(6.0, 16.0)
            back_m += rng.uniform(0.0, 5.0) if kind == "house" else rng.choice([0.0, 0.0, 0.6])
            plot = self._plot(b, a, depth, back_m)
            if plot is None or not self.site.is_free(plot.polygon(CLEARANCE_M)):
                # Not free: try again a little further on
                s += 3.0
                continue
            parts.append(self._build_on(plot, kind, detail=True))
            if kind == "house" and frontage.walkway:
                parts += self._garden(plot, back_m)
            # Blocks stand almost wall to wall, other buildings have space between them
            s += width + (rng.uniform(0.2, 1.0) if kind == "block" else rng.uniform(2.0, 7.0)) + CLEARANCE_M
        return parts

    def skyline(self) -> list[Mesh]:
        """Build free-standing buildings behind the first row."""
        rng, terrain = self.rng, self.site.terrain
        lower = terrain.origin_xy + 20.0
        # Cells are 4 m wide; buildings keep 20 m from the border
        extent = np.array(terrain.z.shape[::-1]) * 4.0 - 40.0
        count = int(extent.prod() * SKYLINE_TRIES_PER_M2)
        spots = lower + rng.random((count, 2)) * extent
        away = self.site.distance_to_road(spots)
        near = (away > SKYLINE_MIN_M) & (away < SKYLINE_MAX_M)
        parts = []
        for xy in spots[near & (rng.random(count) < self.style.skyline)]:
            kind = self._draw_kind()
            width, depth = self._draw_size(kind)
            # Behind the first row, buildings are roughly aligned with the axes
            angle = rng.choice([0.0, 0.5 * np.pi]) + rng.normal(0.0, 0.05)
            along = np.array([np.cos(angle), np.sin(angle)])
            plot = Plot(xy, along, width, depth)
            if self.site.is_free(plot.polygon(3.0)):
                parts.append(self._build_on(plot, kind, detail=False))
        return parts

    def _draw_kind(self) -> str:
        names, shares = zip(*self.style.kinds, strict=True)
        return str(self.rng.choice(names, p=np.array(shares) / sum(shares)))

    def _draw_size(self, kind: str) -> tuple[float, float]:
        return float(self.rng.uniform(*_WIDTH_M[kind])), float(self.rng.uniform(*_DEPTH_M[kind]))

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

    def _build_on(self, plot: Plot, kind: str, detail: bool) -> Mesh:
        self.site.take(plot.polygon(0.3))
        corners = plot.world(
            np.array([[0, 0], [plot.width_m, 0], [plot.width_m, plot.depth_m], [0, plot.depth_m]], float)
        )
        # A building stands on its lowest corner; its walls reach into the ground
        return self.maker.build(kind, plot, float(self.site.height(corners).min()), detail)

    def _garden(self, plot: Plot, back_m: float) -> list[Mesh]:
        """Build a hedge or a fence along the walkway, with a gap for the door."""
        rng, y = self.rng, -back_m - GARDEN_M
        kind = rng.choice(["hedge", "fence", "none"], p=[0.35, 0.35, 0.3])
        if kind == "none":
            return []
        gate = rng.uniform(0.3, 0.6) * plot.width_m
        parts = []
        # Two pieces of hedge or fence, with a gap of 1.6 m for the gate
        for start, end in ((0.0, gate - 0.8), (gate + 0.8, plot.width_m)):
            ends = np.array([[start, y], [end, y]])
            line = shapely.LineString(plot.world(ends)).buffer(0.35)
            heights = self.site.height(plot.world(ends))
            if end - start > 1.5 and np.ptp(heights) < 0.4 and self.site.is_free(line):
                self.site.take(line)
                parts.append(self.maker.border(str(kind), plot, ends, float(heights.min())))
        return parts
