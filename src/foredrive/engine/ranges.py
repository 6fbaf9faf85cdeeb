"""Checks of the numbers in schedules. A wrong number is reported before anything is read or trained."""

import math

from foredrive.errors import InputError


def check_at_least(record: object, **least: int) -> None:
    """Check that numbers of a record are finite and not below their least values.

    Args:
        record: a schedule, or another record of numbers; None is allowed, and tuples are checked by entry.
        least: the least value of each entry, by name.

    Raises:
        InputError: an entry is smaller, or not finite. The message names it.
    """
    for name, bound in least.items():
        value = getattr(record, name)
        numbers = value if isinstance(value, tuple) else () if value is None else (value,)
        for number in numbers:
            # Written so that NaN fails as well
            if not (math.isfinite(number) and number >= bound):
                raise InputError(f"{name} is {number:g}, but has to be {bound:g} or more")


def check_shares(record: object, *names: str) -> None:
    """Check that numbers of a record are from 0 to 1.

    Raises:
        InputError: an entry is not. The message names it.
    """
    for name in names:
        value = getattr(record, name)
        if not 0 <= value <= 1:
            raise InputError(f"{name} is {value:g}, but is a share from 0 to 1")
