"""Files of results, truth and poses from outside: JSON, or pickles of plain data.

One rule for pickles, here and in data sets: `data.safe_pickle` builds containers, numbers, texts and numpy
arrays, and refuses a file that asks for anything else, so that no code of the file is run.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

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
