"""CARLA's own map of Town02, and a world around it that stands in for a server."""

import gzip
from typing import Any

import pytest

from foredrive.towns.map.loading import MAP_FOLDER


@pytest.fixture(scope="session")
def carla() -> Any:
    return pytest.importorskip("carla", reason="CARLA's client is not installed")


@pytest.fixture(scope="session")
def town02(carla: Any) -> Any:
    """A `carla.Map`: it needs no server."""
    return carla.Map("Town02", gzip.decompress((MAP_FOLDER / "Town02.xodr.gz").read_bytes()).decode())
