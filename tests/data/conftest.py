"""Logs that several tests read and none changes."""

from pathlib import Path

import pytest
import synthetic_log as world


@pytest.fixture(scope="session")
def flat_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data root with the synthetic log flat_train/flat: 5 s at 10 Hz."""
    root = tmp_path_factory.mktemp("flat")
    world.write(root)
    return root


@pytest.fixture(scope="session")
def flat_log(flat_root: Path) -> Path:
    return flat_root / "logs" / "flat_train" / "flat"
