import os
import shutil
from pathlib import Path

import emulation
import pytest

CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "foredrive" / "tests"


@pytest.fixture(scope="session")
def hooks() -> Path:
    if shutil.which("g++") is None:
        pytest.skip("no g++ to build an emulated card")
    return emulation.built_hooks(CACHE)
