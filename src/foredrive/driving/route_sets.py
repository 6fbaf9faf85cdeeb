"""Route sets: CARLA's route files, and the sets that are shipped with the package."""

import json
import math
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.scene.conditions import Conditions, conditions_of_weather

SHIPPED = "route_sets.json"
ROUTE_FILE = ".xml"
"""Ending of the names of CARLA's route files."""
SHORT_10, OF = "town05-short-10", "town05-short"
"""The ten routes of the first version of Town05 short are the first ten of today's 32."""


@dataclass(frozen=True, eq=False)
class RouteWaypoints:
    """A route as W waypoints, m, in the right-handed world frame.

    Raises:
        InputError: the id cannot be part of a file name.
    """

    id: str
    """Id of the route, used in the file names of its drives: letters, digits, dots, dashes and
    underscores."""
    town: str
    xyz_m: Float64[np.ndarray, "W 3"]
    scenarios: tuple[str, ...] = ()
    """Types of the scenarios that its file places on it. Drives have others, of their own."""
    weathers: tuple[Conditions, ...] = ()
    """The weather that its file sets, from the begin to the end of the route."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[\w-][\w.-]{0,99}", self.id):
            raise InputError(
                f"a route's id is letters, digits, dots, dashes and underscores, got {self.id!r}"
            )


def route_set_names() -> tuple[str, ...]:
    """Return the names of the sets that are shipped with the package."""
    return (*shipped_sets(), SHORT_10)


def load_route_set(name_or_path: str) -> list[RouteWaypoints]:
    """Load a set that is shipped with the package, or a CARLA route file (`….xml`).

    Raises:
        InputError: the set or the file does not exist, or the file has an error.
    """
    if name_or_path.endswith(ROUTE_FILE):
        return read_carla_routes(Path(name_or_path))
    sets = shipped_sets()
    if name_or_path == SHORT_10:
        return sets[OF][:10]
    if name_or_path not in sets:
        names = ", ".join(route_set_names())
        raise InputError(f"unknown route set {name_or_path!r}: one of {names}, or a CARLA route file (.xml)")
    return sets[name_or_path]


def shipped_sets() -> dict[str, list[RouteWaypoints]]:
    """Load all sets of the package's data file."""
    text = resources.files("foredrive.driving").joinpath(SHIPPED).read_text()
    return {
        name: [RouteWaypoints(row["id"], row["town"], np.array(row["xyz_m"], dtype=float)) for row in rows]
        for name, rows in json.loads(text).items()
    }


def read_carla_routes(path: Path) -> list[RouteWaypoints]:
    """Read a route file of CARLA's leaderboards or of Bench2Drive.

    Waypoints are `waypoint` in leaderboard 1.0, and `waypoints/position` in 2.x and Bench2Drive. The y axis
    is mirrored because CARLA's world is left-handed.

    Raises:
        InputError: the file is missing, is no XML or does not have that form. The error names file and route.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise InputError(f"cannot read the routes {path}: {error.strerror}") from None
    except ElementTree.ParseError as error:
        raise InputError(f"the routes {path} are not valid XML: {error}") from None
    routes = [_route(path, number, element) for number, element in enumerate(root.iter("route"))]
    if not routes:
        raise InputError(f"there is no route in {path}")
    twice = [name for name, count in Counter(route.id for route in routes).items() if count > 1]
    if twice:
        raise InputError(f"{path} has several routes with the id {twice[0]!r}; ids must be unique")
    return routes


def write_shipped(path: Path, sets: dict[str, Sequence[RouteWaypoints]]) -> None:
    """Write routes in the format of the package's data file, with coordinates rounded to centimetres."""
    content = {
        name: [
            {"id": route.id, "town": route.town, "xyz_m": np.round(route.xyz_m, 2).tolist()}
            for route in routes
        ]
        for name, routes in sets.items()
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, separators=(",", ":")).replace('{"id"', '\n{"id"') + "\n")


def _route(path: Path, number: int, element: ElementTree.Element) -> RouteWaypoints:
    name = element.get("id")
    town = element.get("town")
    where = f"route {name if name is not None else f'number {number + 1}'} of {path}"
    if name is None or town is None:
        raise InputError(f"{where} has no {'id' if name is None else 'town'}")
    waypoints = [*element.findall("waypoint"), *element.findall("waypoints/position")]
    scenarios = tuple(scenario.get("type", "?") for scenario in element.findall("scenarios/scenario"))
    if len(waypoints) < 2:
        raise InputError(f"{where} has {len(waypoints)} waypoints; a route needs at least two")
    try:
        xyz = [[float(point.attrib[axis]) for axis in ("x", "y", "z")] for point in waypoints]
    except (KeyError, ValueError) as error:
        raise InputError(f"{where} has a waypoint without numbers for x, y and z: {error}") from None
    if not all(map(math.isfinite, np.ravel(xyz).tolist())):
        raise InputError(f"{where} has a waypoint that is not finite")
    try:
        # CARLA's y axis points to the right
        return RouteWaypoints(
            name, town, np.array(xyz) * [1.0, -1.0, 1.0], scenarios, _weathers(element, where)
        )
    except InputError as error:
        raise InputError(f"route number {number + 1} of {path}: {error}") from None


def _weathers(element: ElementTree.Element, where: str) -> tuple[Conditions, ...]:
    """Return the weather of a route, at one place of leaderboard 1.0 or at several of 2.x."""
    rows = [row.attrib for row in (*element.findall("weather"), *element.findall("weathers/weather"))]
    try:
        numbers = [{name: float(text) for name, text in row.items() if name != "id"} for row in rows]
    except ValueError as error:
        raise InputError(f"{where} has weather that is no number: {error}") from None
    for row in numbers:
        if not all(map(math.isfinite, row.values())):
            raise InputError(f"{where} has weather that is not finite")
    numbers.sort(key=lambda row: row.get("route_percentage", 0.0))
    return tuple(conditions_of_weather(row) for row in numbers)
