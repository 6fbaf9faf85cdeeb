"""Names of the towns, for modules that need only the names."""

from foredrive.errors import InputError

TOWNS = ("Town01", "Town02", "Town03", "Town04", "Town05", "Town06", "Town07", "Town10HD")
TEST_TOWNS = ("Town05",)
"""Towns held out for testing, as in the papers. All others are for training."""


def check_town(name: str) -> None:
    """Raise an `InputError` that lists the known towns if there is no town of this name."""
    if name not in TOWNS:
        raise InputError(f"unknown town {name!r}: one of {', '.join(TOWNS)}")
