"""Loads the map of a town or of a tile.

The maps are the OpenDRIVE files in py123d's wheel (CARLA, CC BY 4.0).
"""

import contextlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import py123d.parser.opendrive

from foredrive.errors import InputError
from foredrive.towns.map.names import check_town, tile_bounds_m, town_of
from foredrive.towns.map.opendrive import read_opendrive
from foredrive.towns.map.tiles import cut_out, roads_within
from foredrive.towns.map.town_map import TownMap

MAP_FOLDER = Path(py123d.parser.opendrive.__file__).parent / "carla_maps"


@lru_cache(maxsize=2)
def load_town_map(name: str) -> TownMap:
    """Read the map of a town or of a tile (takes 0.2 to 9 s).

    Raises:
        InputError: there is no such town, or no road in the tile.
    """
    roads, bounds_m = load_roads(name), tile_bounds_m(name)
    if bounds_m is None:
        return roads
    tile = cut_out(roads, bounds_m)
    if not tile.lanes:
        raise InputError(f"there is no road to drive on in {name}")
    return tile


@lru_cache(maxsize=1)
def load_roads(name: str) -> TownMap:
    """Read the whole roads of a town, or of a tile and around it.

    Raises:
        InputError: there is no such town.
    """
    with xodr_file(name) as path:
        return read_opendrive(path, name)


@contextlib.contextmanager
def xodr_file(name: str) -> Iterator[Path]:
    """Yield the OpenDRIVE file of a town, or one of the roads of a tile and around it.

    Raises:
        InputError: there is no such town.
    """
    check_town(name)
    path, bounds_m = MAP_FOLDER / f"{town_of(name)}.xodr.gz", tile_bounds_m(name)
    if bounds_m is None:
        yield path
        return
    with roads_within(path, bounds_m) as cut:
        yield cut
