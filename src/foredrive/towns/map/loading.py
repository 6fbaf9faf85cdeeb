"""Loads the map of a town or of a tile.

The maps are the OpenDRIVE files in py123d's wheel (CARLA, CC BY 4.0).
"""

import contextlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import py123d.parser.opendrive

from foredrive.errors import InputError
from foredrive.towns.map.names import check_town, map_name, own_map, tile_bounds_m, town_of
from foredrive.towns.map.opendrive import read_opendrive
from foredrive.towns.map.own_maps import completed, reading_own
from foredrive.towns.map.tiles import cut_out, roads_within
from foredrive.towns.map.town_map import TownMap

MAP_FOLDER = Path(py123d.parser.opendrive.__file__).parent / "carla_maps"


def load_town_map(name: str) -> TownMap:
    """Read the map of a town, of a tile or of a file (takes 0.2 to 9 s).

    Raises:
        InputError: there is no such town, or no road in it.
    """
    check_town(name)
    return _town_map(name, map_name(name))


@lru_cache(maxsize=2)
def _town_map(name: str, written: str) -> TownMap:
    """Read the map of a town once for each content of its file, which `written` has a digest of."""
    roads, bounds_m = load_roads(name), tile_bounds_m(name)
    town = roads if bounds_m is None else cut_out(roads, bounds_m)
    if not town.lanes:
        raise InputError(f"there is no road to drive on in {name}")
    return town


def load_roads(name: str) -> TownMap:
    """Read the whole roads of a town or of a file, or of a tile and around it.

    Raises:
        InputError: there is no such town, or the file cannot be read.
    """
    check_town(name)
    return _roads(name, map_name(name))


@lru_cache(maxsize=1)
def _roads(name: str, written: str) -> TownMap:
    with xodr_file(name) as path:
        return read_opendrive(path, written)


@contextlib.contextmanager
def xodr_file(name: str) -> Iterator[Path]:
    """Yield the OpenDRIVE file of a town, or one of the roads of a tile and around it.

    Raises:
        InputError: there is no such town, or a file of one's own cannot be read in this context.
    """
    check_town(name)
    own = own_map(name)
    if own is not None:
        with reading_own(own), completed(own) as whole:
            yield whole
        return
    path, bounds_m = MAP_FOLDER / f"{town_of(name)}.xodr.gz", tile_bounds_m(name)
    if bounds_m is None:
        yield path
        return
    with roads_within(path, bounds_m) as cut:
        yield cut
