"""The smallest town, built once."""

import pytest

from foredrive.towns.conditions import Conditions
from foredrive.towns.map.town_map import TownMap, load_town_map
from foredrive.towns.world import World


@pytest.fixture(scope="session")
def town02() -> TownMap:
    return load_town_map("Town02")


@pytest.fixture(scope="session")
def world02(town02: TownMap) -> World:
    return World(town02, seed=3, conditions=Conditions(hour=12.0))
