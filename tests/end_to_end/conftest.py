"""The program with a recipe of seconds."""

from collections.abc import Callable
from pathlib import Path

import pytest
from miniature import miniature

from foredrive.cli.main import main
from foredrive.runs.recipes.known import RECIPES


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
