"""Numbers of records in files of results: read and checked, and what is left out of them."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from foredrive.errors import InputError

MAX_NUMBER = 1e12
"""Limit of numbers in files: beyond it, squares and products lose their precision."""

_log = logging.getLogger(__name__)


def tell_left_out(path: Path, counts: Mapping[str, int], given: int) -> None:
    """Say in one line how many records of a file are left out.

    Args:
        path: the file or folder, for the message.
        counts: numbers of records left out, by what they are: a noun in the plural.
        given: number of all records of the file.

    Raises:
        InputError: all are left out.
    """
    parts = [f"{count} {what}" for what, count in counts.items() if count]
    if not parts:
        return
    text = f"{path}: left out of {given}: {', '.join(parts)}"
    if sum(counts.values()) == given:
        raise InputError(f"{text}: nothing remains to be scored")
    _log.warning("%s", text)


def read_numbers(record: Mapping[str, Any], key: str, count: int, where: str) -> Float[ndarray, "n"]:
    """Return `count` finite numbers of a record, none beyond `MAX_NUMBER`."""
    try:
        value = np.atleast_1d(np.asarray(record[key], dtype=np.float64))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where} has no {key} of {count} number(s)") from error
    if value.shape != (count,):
        raise InputError(f"{where} has no {key} of {count} number(s)")
    if not np.isfinite(value).all():
        raise InputError(f"{where}: its {key} is not finite")
    if not (np.abs(value) <= MAX_NUMBER).all():
        raise InputError(f"{where}: its {key} is beyond {MAX_NUMBER:g}")
    return value


def read_number_rows(
    records: Sequence[Mapping[str, Any]], key: str, count: int, names: Sequence[str]
) -> Float[ndarray, "n count"]:
    """Return `read_numbers` of every record."""
    try:
        # Fast path: all rows at once. Any fault is found again below, with the record's name
        values = np.array([record[key] for record in records], dtype=np.float64)
        shape = (len(records), count) if count > 1 else (len(records),)
        if values.shape == shape and (np.abs(values) <= MAX_NUMBER).all():
            return values.reshape(-1, count)
    except (KeyError, TypeError, ValueError, OverflowError):
        pass
    rows = [read_numbers(record, key, count, names[n]) for n, record in enumerate(records)]
    return np.array(rows).reshape(-1, count)
