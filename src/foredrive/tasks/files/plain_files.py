"""Files of results, truth and poses from outside: JSON, or pickles of plain data.

One rule for pickles, here and in data sets: `data.safe_pickle` builds containers, numbers, texts and numpy
arrays, and refuses a file that asks for anything else, so that no code of the file is run.
"""

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from foredrive.data.safe_pickle import load_pickle
from foredrive.errors import InputError

PICKLES = (".pkl", ".pickle")


def read_plain(path: Path, *, arrays: bool = False) -> Any:
    """Return the content of a JSON file, or of a pickle of plain data. An entry that is null is as absent.

    Args:
        path: a pickle if it ends in .pkl or .pickle.
        arrays: keep the numpy arrays of a pickle. Otherwise they become lists, as in JSON.

    Raises:
        InputError: it cannot be read, or is a pickle of more than plain data.
    """
    if path.suffix.lower() in PICKLES:
        content = load_pickle(path)
        return content if arrays else _as_json(content)
    try:
        return json.loads(path.read_text("utf-8-sig"), object_pairs_hook=_without_null)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON that can be read") from error


def _without_null(entries: list[tuple[str, Any]]) -> dict[str, Any]:
    return {key: entry for key, entry in entries if entry is not None}


def _as_json(value: Any) -> Any:
    """Return containers, arrays and numbers as JSON would have them."""
    if isinstance(value, dict):
        return _without_null([(str(key), _as_json(entry)) for key, entry in value.items()])
    if isinstance(value, list | tuple):
        return [_as_json(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return _as_json(value.tolist()) if value.dtype == object else value.tolist()
    return value.item() if isinstance(value, np.generic) else value


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
