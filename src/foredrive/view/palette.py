"""The colours and type sizes of all pictures. All pictures have one dark background."""

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.colors import to_rgb

from foredrive.scene import Category, Command, MapKind
from foredrive.scene.map_elements import ElementKind

GROUND = "#11151c"
"""Background of every picture."""
PANEL = "#1a202a"
"""Background of placeholders and empty panels."""
INK = "#e8ecf2"
FAINT = "#8b95a5"
GRID = "#2b3442"

EXPERT = "#2ee6a8"
"""The driven path."""
PLAN = "#ff4d4f"
"""The model's plan."""
EGO = "#f5f7fa"
SCENARIO = "#8a78e8"

BOX_COLOURS: dict[Category, str] = {
    Category.CAR: "#4cc9f0",
    Category.TRUCK: "#7b8cff",
    Category.BUS: "#b388ff",
    Category.TRAILER: "#9d7bd8",
    Category.CONSTRUCTION_VEHICLE: "#e0a458",
    Category.MOTORCYCLE: "#ff8fd2",
    Category.BICYCLE: "#ff70a6",
    Category.PEDESTRIAN: "#ffe14d",
    Category.ANIMAL: "#c0f060",
    Category.TRAFFIC_CONE: "#ff9a3c",
    Category.BARRIER: "#ff7b54",
    Category.OTHER: "#c8d0da",
}

MAP_COLOURS: dict[MapKind, str] = {
    MapKind.LANE_CENTRE: "#46566b",
    MapKind.LANE_BOUNDARY: "#77879c",
    MapKind.ROAD_EDGE: "#c3cad4",
    MapKind.CROSSWALK: "#d9c27a",
    MapKind.WALKWAY: "#5d7a68",
    MapKind.STOP_ZONE: "#c9655f",
    MapKind.INTERSECTION: "#4a5a86",
}

ELEMENT_COLOURS: dict[ElementKind, str] = {
    ElementKind.DIVIDER: "#e8a33d",
    ElementKind.CROSSING: "#5b9bff",
    ElementKind.BOUNDARY: "#ef6a5a",
    ElementKind.CENTRELINE: "#5b6b80",
}

VOXEL_COLOURS: dict[str, str] = {
    "others": "#c8d0da",
    "barrier": "#ff7b54",
    "bicycle": "#ff70a6",
    "bus": "#b388ff",
    "car": "#4cc9f0",
    "construction_vehicle": "#e0a458",
    "motorcycle": "#ff8fd2",
    "pedestrian": "#ffe14d",
    "traffic_cone": "#ff9a3c",
    "trailer": "#9d7bd8",
    "truck": "#7b8cff",
    "driveable_surface": "#6b7480",
    "other_flat": "#8a7f9a",
    "sidewalk": "#b79aa8",
    "terrain": "#8fae62",
    "manmade": "#d8ccb4",
    "vegetation": "#2f8f46",
}
"""By name of the class in Occ3D and OpenOcc. Road users have the colours of their boxes."""

TRUE_POSITIVE = "#2ee6a8"
FALSE_POSITIVE = "#f07a3a"
FALSE_NEGATIVE = "#4d7de0"
KNOWN_FREE = "#2a323e"

RANGE_MAP = matplotlib.colormaps["plasma"].reversed()
HEIGHT_MAP = matplotlib.colormaps["viridis"]
RANGE_SPAN = (0.05, 0.75)
"""The part of the colour map that stands out from the background."""
MIN_RANGE_M, MAX_RANGE_M = 3.0, 80.0
"""Ends of the logarithmic range scale, m."""


def label(kind: Category | MapKind | Command) -> str:
    """Return a kind's name for a legend: TRAFFIC_CONE becomes "traffic cone"."""
    return kind.name.lower().replace("_", " ")


def box_colour(category: int) -> str:
    """Return the colour of a `Category`; an unknown number has the colour of OTHER."""
    return BOX_COLOURS[Category(category) if category in set(Category) else Category.OTHER]


def rgb255(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of a colour #rrggbb."""
    red, green, blue = (round(255 * c) for c in to_rgb(colour))
    return red, green, blue


def range_colours(range_m: Float[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n 3"]:
    """Return colours of ranges from bright (near) to dark (far), on a logarithmic scale from 3 to 80 m."""
    scale = np.log(np.clip(range_m, MIN_RANGE_M, MAX_RANGE_M) / MIN_RANGE_M) / np.log(
        MAX_RANGE_M / MIN_RANGE_M
    )
    return (RANGE_MAP(RANGE_SPAN[0] + (RANGE_SPAN[1] - RANGE_SPAN[0]) * scale)[..., :3] * 255).astype(
        np.uint8
    )
