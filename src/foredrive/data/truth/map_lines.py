"""Lines of maps in the world frame: without duplicates, merged, and clipped. All keep their heights."""

from collections.abc import Iterable, Sequence

import numpy as np
import shapely
from jaxtyping import Float64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from shapely import LineString, Polygon, STRtree
from shapely.geometry.base import BaseGeometry

Line = Float64[np.ndarray, "_ 3"]

SAME_M = 0.3
"""Lines closer than this are one line that two lanes share, and ends closer than this are one end."""
SIMPLIFIED_M = 0.02
"""Maximum distance by which a line moves when vertices are left out."""


def line_strings(lines: Iterable[Line]) -> list[LineString]:
    """Return polylines as geometries with few vertices. Lines without length are left out."""
    made = [LineString(line) for line in lines if len(line) > 1]
    return [shapely.simplify(line, SIMPLIFIED_M) for line in made if line.length > 0]


def without_near(
    lines: Sequence[LineString], others: Sequence[BaseGeometry], reach_m: float
) -> list[LineString]:
    """Return the parts of lines that are farther than `reach_m` from all others.

    With a negative `reach_m` they are the parts that do not lie so deep in another, which is an area.
    """
    if not others:
        return list(lines)
    # Zones around the others; a tree finds those that a line can meet
    zones = shapely.buffer(np.array(others, dtype=object), reach_m, quad_segs=2)
    tree = STRtree(zones)
    kept: list[LineString] = []
    for line in lines:
        near = tree.query(line, predicate="intersects")
        # The rest of the line outside of all near zones
        kept += _parts(line.difference(shapely.union_all(zones[near])) if len(near) else line)
    return kept


def distinct(lines: Sequence[LineString]) -> list[LineString]:
    """Return lines without the parts that an earlier line has too (within `SAME_M`)."""
    # Exact duplicates first, of which the earliest stays
    unique = list({_key(line): line for line in reversed(lines)}.values())[::-1]
    if len(unique) < 2:
        return unique
    zones = shapely.buffer(np.array(unique, dtype=object), SAME_M, quad_segs=2, cap_style="flat")
    tree = STRtree(zones)
    kept: list[LineString] = []
    for number, line in enumerate(unique):
        near = tree.query(line, predicate="intersects")
        # Only earlier lines take parts away, so that one of two equal parts stays
        earlier = near[near < number]
        kept += _parts(line.difference(shapely.union_all(zones[earlier])) if len(earlier) else line)
    return kept


def merged(lines: Sequence[LineString], min_length_m: float, directed: bool = False) -> list[LineString]:
    """Join lines at ends where exactly two of them meet. Shorter results are left out.

    Ends within `SAME_M` of each other are moved to their mean first.

    Args:
        lines: the pieces.
        min_length_m: minimum length of a result.
        directed: join only the end of one line to the start of another.
    """
    if not lines:
        return []
    # line_merge joins lines where exactly two meet
    joined = shapely.line_merge(shapely.multilinestrings(_with_common_ends(lines)), directed=directed)
    whole = [shapely.simplify(line, SIMPLIFIED_M) for line in _parts(joined)]
    return [line for line in whole if line.length >= min_length_m]


def united(polygons: Sequence[Polygon]) -> list[Polygon]:
    """Unite polygons that touch. A united polygon has the mean height of its parts."""
    if not polygons:
        return []
    tree = STRtree(polygons)
    # Groups of touching polygons are connected components
    pairs = tree.query(np.array(polygons, dtype=object), predicate="intersects")
    count, group = _components(pairs, len(polygons))
    out = []
    for number in range(count):
        members = [polygons[k] for k in np.flatnonzero(group == number).tolist()]
        if len(members) == 1:
            out += members
            continue
        z_m = float(shapely.get_coordinates(members, include_z=True)[:, 2].mean())
        out.append(shapely.force_3d(shapely.union_all(shapely.force_2d(members)), z_m))
    return [polygon for polygon in out if isinstance(polygon, Polygon)]


def coordinates(geometry: BaseGeometry) -> Line:
    """Return the vertices of one line or ring."""
    return shapely.get_coordinates(geometry, include_z=True)


def clipped(
    line: Line, lower_m: tuple[float, float], upper_m: tuple[float, float]
) -> list[Float64[np.ndarray, "_ 3"]]:
    """Return the parts of a line within a rectangle of its own frame. A closed line keeps no seam."""
    # The clipped line may come in pieces at the seam of a closed line: merge them again
    inside = LineString(line).intersection(shapely.box(*lower_m, *upper_m))
    if isinstance(inside, shapely.MultiLineString):
        inside = shapely.line_merge(inside)
    return [coordinates(part) for part in _parts(inside)]


def _with_common_ends(lines: Sequence[LineString]) -> list[LineString]:
    """Move ends within `SAME_M` of each other to their mean. A line that collapses is left out."""
    points = [coordinates(line) for line in lines]
    # Both ends of every line, and groups of ends that are close
    ends = np.array([[line[0], line[-1]] for line in points]).reshape(-1, 3)
    pairs = KDTree(ends).query_pairs(SAME_M, output_type="ndarray")
    count, group = _components(pairs.T, len(ends))
    size = np.bincount(group, minlength=count)
    # Mean of each group, coordinate by coordinate
    mean = np.stack([np.bincount(group, ends[:, axis], count) / size for axis in range(3)], axis=-1)
    for number, line in enumerate(points):
        line[0], line[-1] = mean[group[2 * number]], mean[group[2 * number + 1]]
    moved = [LineString(line) for line in points]
    return [line for line in moved if line.length > 0 and not (len(line.coords) == 2 and line.is_closed)]


def _components(pairs: np.ndarray, count: int) -> tuple[int, np.ndarray]:
    links = coo_array((np.ones(pairs.shape[1], dtype=bool), (pairs[0], pairs[1])), shape=(count, count))
    number, group = connected_components(links, directed=False)
    return int(number), group


def _parts(geometry: BaseGeometry) -> list[LineString]:
    """Return the lines of a geometry with length."""
    return [
        part for part in shapely.get_parts(geometry) if isinstance(part, LineString) and part.length > 1e-6
    ]


def _key(line: LineString) -> tuple[float, ...]:
    """Return a key that is the same for a line and its reverse."""
    # Adding 0 turns -0.0 into 0.0, so that equal lines have equal keys
    rounded = np.round(coordinates(line), 2) + 0.0
    flat, back = tuple(rounded.ravel().tolist()), tuple(rounded[::-1].ravel().tolist())
    return min(flat, back)
