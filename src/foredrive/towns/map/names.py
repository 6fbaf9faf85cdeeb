"""The towns there are, for those that need to know no more of them."""

from foredrive.errors import InputError

TOWNS = ("Town01", "Town02", "Town03", "Town04", "Town05", "Town06", "Town07", "Town10HD")
TEST_TOWNS = ("Town05",)
"""Held out, as in the papers; all others are for training."""


def check_town(name: str) -> None:
    """Raises `InputError`, which names the known towns, if there is no town of this name."""
    if name not in TOWNS:
        raise InputError(f"unknown town {name!r}: one of {', '.join(TOWNS)}")
