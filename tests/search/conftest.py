"""Small towers, and a log they can look at."""

from pathlib import Path

import pytest
from miniature import write_log
from small_towers import PlainTowers, save_clip, save_siglip

from foredrive.data import LogPath


@pytest.fixture(scope="session")
def towers() -> PlainTowers:
    return PlainTowers()


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return write_log(tmp_path_factory.mktemp("searched"), frames=21)


@pytest.fixture(scope="session")
def clip_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_clip(tmp_path_factory.mktemp("towers") / "clip")


@pytest.fixture(scope="session")
def siglip_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_siglip(tmp_path_factory.mktemp("towers") / "siglip")
