"""The program with a recipe of seconds, and a log and a run that tests read and none changes."""

from collections.abc import Callable
from pathlib import Path

import pytest
from miniature import miniature, write_log

from foredrive.cli.main import main
from foredrive.data import LogPath
from foredrive.recipes import RECIPES
from foredrive.runs import Run, train_run


@pytest.fixture
def foredrive(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Runs the program, which knows the recipe "miniature" too; its exit code and what stood on stderr."""
    monkeypatch.setitem(RECIPES, "miniature", miniature())

    def run(*args: str | Path) -> tuple[int, str]:
        capsys.readouterr()
        code = main([str(arg) for arg in args])
        return code, capsys.readouterr().err

    return run


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return write_log(tmp_path_factory.mktemp("logs"))


@pytest.fixture(scope="session")
def trained(log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train_run(miniature(), [log], tmp_path_factory.mktemp("runs") / "trained")
