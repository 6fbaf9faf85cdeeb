"""Names of the towns, for modules that need only the names.

A town of `LARGE_TOWNS` is driven in tiles: `Town12_Tile_4_-7` is the square of `TILE_M` around the point
(4, -7) × `TILE_STEP_M` of Town12, so neighbouring tiles overlap. The path of an OpenDRIVE file is a town too.
"""

import hashlib
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from foredrive.errors import InputError

TOWNS = ("Town01", "Town02", "Town03", "Town04", "Town05", "Town06", "Town07", "Town10HD", "Town15")
"""Towns that are built whole."""
LARGE_TOWNS = {
    "Town11": "Town11_Tile_-7_42",
    "Town12": "Town12_Tile_4_-16",
    "Town13": "Town13_Tile_14_-16",
}
"""Towns of many kilometres, which are built in tiles, each with a tile in the middle of streets."""
TEST_TOWNS = ("Town05",)
"""Towns held out for testing, as in the papers."""
UNSEEN_TOWNS = ("Town13", "Town15")
"""Towns in which nothing is trained and nothing is tuned. All other towns but Town05 are for training."""
TILE_M, TILE_STEP_M = 1000.0, 250.0
"""Side of a tile, and distance of the centres of neighbouring ones."""
TILE_EDGE_M = 150.0
"""Least distance of a route from the edge of its tile: traffic needs road around it."""

_TILE = re.compile(r"(\w+)_Tile_(-?\d+)_(-?\d+)")


def check_town(name: str) -> None:
    """Raise an `InputError` that lists the known towns if there is no town, tile or file of this name."""
    file = own_map(name)
    if file is not None:
        if not file.is_file():
            raise InputError(f"{name}: there is no such file")
        return
    if name in LARGE_TOWNS:
        raise InputError(
            f"{name} is built in tiles of {TILE_M:.0f} m: name one by its centre in steps of "
            f"{TILE_STEP_M:.0f} m, for example {LARGE_TOWNS[name]}"
        )
    tile = _TILE.fullmatch(name)
    if name not in TOWNS and (tile is None or tile[1] not in LARGE_TOWNS):
        tiles = ", ".join(f"{town}_Tile_X_Y" for town in LARGE_TOWNS)
        raise InputError(
            f"unknown town {name!r}: one of {', '.join(TOWNS)}, a tile: {tiles}, or a file that ends in .xodr"
        )


def own_map(name: str) -> Path | None:
    """Return the OpenDRIVE file that a town's name is the path of, or None."""
    return Path(name) if name.endswith((".xodr", ".xodr.gz")) else None


def map_name(town: str) -> str:
    """Return what logs call a town: its name, or that of its file with a digest of what is in it."""
    file = own_map(town)
    if file is None:
        return town
    return f"{file.name.split('.')[0]}_{hashlib.sha256(file.read_bytes()).hexdigest()[:8]}"


def town_of(name: str) -> str:
    """Return the town of a tile, or the town itself."""
    tile = _TILE.fullmatch(name)
    return name if tile is None else tile[1]


def tile_bounds_m(name: str) -> tuple[float, float, float, float] | None:
    """Return the smallest x, y and the largest x, y of a tile, m, or None for a town that is built whole."""
    tile = _TILE.fullmatch(name)
    if tile is None:
        return None
    x, y = int(tile[2]) * TILE_STEP_M, int(tile[3]) * TILE_STEP_M
    return x - TILE_M / 2, y - TILE_M / 2, x + TILE_M / 2, y + TILE_M / 2


def tile_around(town: str, xy: Float64[np.ndarray, "N 2"]) -> str:
    """Return the name of a town, or of its tile around some points if it is a large one.

    Raises:
        InputError: the points are too far apart for a tile.
    """
    if town not in LARGE_TOWNS:
        return town
    lower, upper = xy.min(0), xy.max(0)
    x, y = np.round((lower + upper) / (2 * TILE_STEP_M)).astype(int).tolist()
    room_m = TILE_M / 2 - TILE_EDGE_M - np.abs((x, y) - (lower + upper) / (2 * TILE_STEP_M)) * TILE_STEP_M
    if ((upper - lower) / 2 > room_m).any():
        wide_m = float((upper - lower).max())
        raise InputError(f"{wide_m:.0f} m wide, more than a tile of {town} ({TILE_M:.0f} m) with its edges")
    return f"{town}_Tile_{x}_{y}"


def is_held_out(name: str) -> bool:
    """Return whether a town or a tile is not for training."""
    return town_of(name) in (*TEST_TOWNS, *UNSEEN_TOWNS)
