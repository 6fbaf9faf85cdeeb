"""Small drives for evaluations."""

from collections.abc import Callable

import pytest
from small_drives import drives

from foredrive.scene import Example


@pytest.fixture
def make_example() -> Callable[..., Example]:
    """Builds a batch from the numbers of its items."""
    return drives
