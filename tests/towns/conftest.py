"""Fixtures of recorded towns."""

import pytest
from small_recording import record_small

from foredrive.data.log_paths import LogPath
from foredrive.towns import recorder
from foredrive.towns.world import World


@pytest.fixture
def built_already(world02: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare building the town again, for which most of the time of a small recording goes."""
    monkeypatch.setattr(recorder, "World", lambda town, seed, conditions: world02)


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return record_small(tmp_path_factory.mktemp("towns"))
