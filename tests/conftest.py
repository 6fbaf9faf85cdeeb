"""Shared by all tests: where the real logs are."""

import os
from pathlib import Path

import pytest

_BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real logs; the test is skipped where there is none."""
    folder = Path(os.environ.get("FOREDRIVE_REAL_DATA", _BESIDE))
    if not folder.is_dir():
        pytest.skip("no real logs here: set FOREDRIVE_REAL_DATA")
    return folder
