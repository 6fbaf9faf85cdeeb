"""Reading of untrusted pickles without running their code."""

import gzip
import importlib
import pickle
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

from foredrive.errors import InputError

_PLAIN = {
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("_codecs", "encode"),
}
"""Names that pickles of arrays and numbers need. Plain containers need none."""

_TABLE = _PLAIN | {
    ("builtins", "slice"),
    ("pandas", "DataFrame"),  # pandas 3; earlier versions name the defining module
    ("pandas", "Index"),
    ("pandas", "RangeIndex"),
    ("pandas.core.frame", "DataFrame"),
    ("pandas.core.internals.managers", "BlockManager"),
    ("pandas._libs.internals", "_unpickle_block"),
    ("pandas.core.indexes.base", "Index"),
    ("pandas.core.indexes.base", "_new_Index"),
    ("pandas.core.indexes.range", "RangeIndex"),
}
"""Names that a pickled pandas table of numbers and strings needs in addition."""


class _Unpickler(pickle.Unpickler):
    def __init__(self, source: Any, allowed: set[tuple[str, str]]) -> None:
        super().__init__(source)
        self._allowed = allowed

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core.", "numpy._core.")  # before numpy 2
        if (module, name) not in self._allowed:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which plain data do not need")
        return getattr(importlib.import_module(module), name)


def load_pickle(file: Path) -> Any:
    """Load a pickle of containers, numbers, strings and numpy arrays only.

    Raises:
        InputError: the file contains anything else, or it is damaged.
    """
    return _load(file, open, _PLAIN)


def load_table(file: Path) -> "pd.DataFrame":
    """Load a gzipped pickle of one pandas table of numbers and strings.

    Raises:
        InputError: the file contains anything else, or it is damaged.
    """
    table = _load(file, gzip.open, _TABLE)
    if not isinstance(table, pd.DataFrame):
        raise InputError(f"{file}: not a table but a {type(table).__name__}")
    return table


def _load(file: Path, opened: Callable[..., Any], allowed: set[tuple[str, str]]) -> Any:
    try:
        with opened(file, "rb") as source, warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="dtype.*align")  # written by an older numpy
            return _Unpickler(source, allowed).load()
    except Exception as error:  # a damaged pickle can raise any error
        raise InputError(f"{file}: cannot read it as a pickle of plain data: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
