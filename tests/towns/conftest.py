"""The towns, each built once."""

import functools
from collections.abc import Callable

import pytest

from foredrive.towns.conditions import Conditions
from foredrive.towns.map.town_map import TownMap, load_town_map
from foredrive.towns.world import World


@pytest.fixture(scope="session")
def town_of() -> Callable[[str], TownMap]:
    """The map of a town by its name; all of them together take some tens of MB."""
    return functools.cache(load_town_map)


@pytest.fixture(scope="session")
def town02(town_of: Callable[[str], TownMap]) -> TownMap:
    return town_of("Town02")


@pytest.fixture(scope="session")
def world02(town02: TownMap) -> World:
    return World(town02, seed=3, conditions=Conditions(hour=12.0))
