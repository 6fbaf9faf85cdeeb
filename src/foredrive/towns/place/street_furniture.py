"""Placement of street furniture behind the walkways, and beside roads without walkways."""

import itertools
from dataclasses import dataclass, field

import numpy as np
import shapely
from jaxtyping import Bool, Float

from foredrive.towns.map.town_map import TownMap
from foredrive.towns.place import furniture_meshes
from foredrive.towns.place.furniture_meshes import RAIL_STEP_M, FurnitureItem, FurnitureMaterials
from foredrive.towns.place.materials import MaterialTable, Surface
from foredrive.towns.place.mesh import Mesh, join
from foredrive.towns.place.props import ThinPoints, join_thin_points, thin_points
from foredrive.towns.place.site import Frontage, Site, frontages
from foredrive.towns.place.styles import Style, style_of

SETBACK_M = 1.2
WALKWAY_STEP_M, OPEN_STEP_M = (7.0, 22.0), (45.0, 140.0)
POLE_STEP_M, POLE_OFFSET_M = 34.0, 2.0
BILLBOARD_OFFSET_M, SITE_OFFSET_M = 5.0, 2.5
FAST_MPS, FAST_WITHIN_M = 27.0, 14.0
"""Speed limit above which a road is a motorway, m/s, and the distance from it within which guard rails stand,
m."""
SECTION_M = 80.0
RAILS, BARRIERS = 0.75, 0.12
"""Shares of a motorway's sections with guard rails and with sound barriers."""
STEEP_M = 0.6

_ON_WALKWAYS = {
    "bench": 0.16,
    "bin": 0.16,
    "hydrant": 0.08,
    "mail_box": 0.06,
    "parking_meter": 0.14,
    "bollards": 0.1,
    "shelter": 0.05,
    "cabinet": 0.07,
    "speed_sign": 0.09,
    "information_sign": 0.09,
}
_ON_OPEN_ROADS = {"speed_sign": 0.5, "direction_sign": 0.25, "information_sign": 0.15, "cabinet": 0.1}


def build_street_furniture(
    town: TownMap, site: Site, table: MaterialTable, rng: np.random.Generator
) -> tuple[Mesh, ThinPoints]:
    """Build guard rails, barriers, power lines, billboards, then small objects.

    Their places are taken from the site.
    """
    # Motorways by their speed limit
    fast = [x.centreline_xyz[:, :2] for x in town.lanes if (x.speed_limit_mps or 0.0) > FAST_MPS]
    motorways = shapely.STRtree([shapely.LineString(line) for line in fast])
    placer = _FurniturePlacer(site, motorways, style_of(town.name), FurnitureMaterials(table), rng)
    # Rails first, because they need continuous space; then large objects, then small ones
    lines = frontages(site.plan, SETBACK_M)
    for frontage in lines:
        if not frontage.walkway:
            placer.rails(frontage)
    for frontage in lines:
        if frontage.line.length > 3 * POLE_STEP_M and rng.random() < placer.style.power_lines:
            placer.power_line(frontage)
        placer.large(frontage)
        placer.small(frontage)
    return join(placer.parts), join_thin_points([thin_points([], Surface.POLE), *placer.thin])


@dataclass
class _FurniturePlacer:
    site: Site
    motorways: shapely.STRtree
    style: Style
    materials: FurnitureMaterials
    rng: np.random.Generator
    parts: list[Mesh] = field(default_factory=list)
    thin: list[ThinPoints] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._things = furniture_meshes.furniture_items(self.materials)

    def rails(self, frontage: Frontage) -> None:
        """Build guard rails or sound barriers along a motorway, section by section."""
        count = int(frontage.line.length / RAIL_STEP_M)
        if count < 3:
            return
        # Points every `RAIL_STEP_M`, marked where a motorway is near
        points = shapely.line_interpolate_point(frontage.line, np.arange(count + 1) * RAIL_STEP_M)
        fast = np.zeros(count + 1, dtype=np.bool_)
        fast[np.unique(self.motorways.query(points, predicate="dwithin", distance=FAST_WITHIN_M)[0])] = True
        xy = shapely.get_coordinates(points)
        z = self.site.height(xy)
        per_section = int(SECTION_M / RAIL_STEP_M)
        for start in range(0, count, per_section):
            # Each section has rails, a barrier or nothing
            u = self.rng.random()
            if u > RAILS + BARRIERS:
                continue
            part = slice(start, min(start + per_section, count) + 1)
            # Only stretches that are near a motorway and free
            usable = fast[part] & self._free_steps(xy[part])
            for run in _runs(usable):
                feet = np.column_stack([xy[part], z[part]])[run]
                if len(feet) < 3:
                    continue
                self.site.take(shapely.LineString(feet[:, :2]).buffer(0.2))
                if u < RAILS:
                    self.parts.append(furniture_meshes.guard_rail(feet, self.materials))
                else:
                    self.parts.append(furniture_meshes.sound_barrier(feet, self.materials))

    def _free_steps(self, xy: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, "N"]:
        """Return for each point whether the way to the next point is free."""
        free = [self.site.is_free(shapely.LineString([a, b]).buffer(0.2)) for a, b in itertools.pairwise(xy)]
        return np.array([*free, False])

    def power_line(self, frontage: Frontage) -> None:
        """Build poles with wires from each pole to the next."""
        last: Float[np.ndarray, 3] | None = None
        for s in np.arange(self.rng.uniform(0.0, POLE_STEP_M), frontage.line.length, POLE_STEP_M):
            foot = self._place("power_pole", frontage, float(s), POLE_OFFSET_M)
            # Wires only between neighbouring poles: a pole may be missing
            near = foot is not None and last is not None and np.linalg.norm(foot - last) < 1.3 * POLE_STEP_M
            if near and foot is not None and last is not None:
                self.parts.append(furniture_meshes.wires(last, foot, self.materials.wire))
            last = foot

    def large(self, frontage: Frontage) -> None:
        """Build billboards and building sites."""
        for name, per_km, aside in (
            ("billboard", self.style.billboards, BILLBOARD_OFFSET_M),
            ("building_site", 0.5, SITE_OFFSET_M),
        ):
            for _ in range(int(self.rng.poisson(per_km * frontage.line.length / 1000.0))):
                self._place(name, frontage, float(self.rng.uniform(0.0, frontage.line.length)), aside)

    def small(self, frontage: Frontage) -> None:
        """Build small objects one after another."""
        kinds = _ON_WALKWAYS if frontage.walkway else _ON_OPEN_ROADS
        step = WALKWAY_STEP_M if frontage.walkway else OPEN_STEP_M
        s = float(self.rng.uniform(*step))
        while s < frontage.line.length:
            self._place(str(self.rng.choice(list(kinds), p=list(kinds.values()))), frontage, s, 0.0)
            s += float(self.rng.uniform(*step))

    def _place(
        self, name: str, frontage: Frontage, s: float, offset_m: float
    ) -> Float[np.ndarray, "3"] | None:
        """Place an object beside a frontage if there is room. Return its foot, or None."""
        thing: FurnitureItem = self._things[name]
        # Direction of the line at the place, also at its end
        reach = min(s + 0.5, frontage.line.length)
        ahead = frontage.at(reach) - frontage.at(reach - 0.5)
        ahead /= np.linalg.norm(ahead)
        left = np.array([-ahead[1], ahead[0]])
        half = thing.room_m
        # Away from the road: left of the line is the road
        xy = frontage.at(s) - (offset_m + max(half[1] - SETBACK_M + 0.25, 0.0)) * left
        corners = xy + np.array(
            [
                a * half[0] * ahead + b * half[1] * left
                for a, b in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
            ]
        )
        area = shapely.Polygon(corners)
        heights = self.site.height(np.concatenate([corners, xy[None]]))
        # No object on steep ground or on another object
        if np.ptp(heights) > STEEP_M or not self.site.is_free(area):
            return None
        self.site.take(area)
        T = np.eye(4)
        # The object's x axis points along the traffic
        T[:2, 0], T[:2, 1], T[:2, 3], T[2, 3] = ahead, left, xy, heights[-1]
        moved = thing.mesh.transformed(T)
        self.parts.append(Mesh(moved.xyz, thing.mesh.uvw, moved.material))
        for surface, points in thing.thin:
            self.thin.append(thin_points([points @ T[:3, :3].T + T[:3, 3]], surface))
        return T[:3, 3].copy()


def _runs(usable: Bool[np.ndarray, "N"]) -> list[slice]:
    """Return ranges of points joined by usable steps, with their last points included."""
    # Starts and ends of the runs of True, by the changes of the padded mask
    edges = np.flatnonzero(np.diff(np.concatenate([[False], usable, [False]]).astype(np.int8)))
    return [slice(int(a), int(b) + 1) for a, b in edges.reshape(-1, 2)]
