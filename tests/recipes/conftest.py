"""A log and a run on it, that several tests read and none changes."""

import pytest
from miniature import miniature, write_log

from foredrive.data import LogPath
from foredrive.recipes import Run, train_run


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return write_log(tmp_path_factory.mktemp("logs"))


@pytest.fixture(scope="session")
def trained(log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run that was never interrupted."""
    return train_run(miniature(), [log], tmp_path_factory.mktemp("runs") / "trained")
