"""Reading of untrusted pickles without running their code."""

import gzip
import importlib
import io
import pickle
import warnings
from collections.abc import Callable, Iterable, Mapping
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
    def __init__(
        self, source: Any, allowed: set[tuple[str, str]], moved: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(source)
        self._allowed, self._moved = allowed, moved or {}

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core.", "numpy._core.")  # before numpy 2
        module = self._moved.get(module, module)
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


def load_records(file: Path, schema: str, moved: Mapping[str, str]) -> Any:
    """Load a pickle of plain data and of the dataclasses of one module.

    Args:
        file: the pickle.
        schema: name of the module; its dataclasses alone are allowed.
        moved: for modules by which old files name the dataclasses, the module that has them.

    Raises:
        InputError: the file contains anything else, or it is damaged.
    """
    module = importlib.import_module(schema)
    records = {
        (schema, name) for name, value in vars(module).items() if hasattr(value, "__dataclass_fields__")
    }
    return _load(file, open, _PLAIN | records, moved)


class PlainPickle:
    """The functions of the module `pickle`, limited to plain data, to be put in its place in a library.

    Args:
        classes: further classes that are allowed, as (module, name).
    """

    UnpicklingError = pickle.UnpicklingError
    HIGHEST_PROTOCOL = pickle.HIGHEST_PROTOCOL
    dump = staticmethod(pickle.dump)
    dumps = staticmethod(pickle.dumps)

    def __init__(self, classes: Iterable[tuple[str, str]] = ()) -> None:
        self._allowed = _PLAIN | set(classes)

    def load(self, source: Any) -> Any:
        """Load plain data from an open file. Raise `pickle.UnpicklingError` if it contains anything else."""
        return _Unpickler(source, self._allowed).load()

    def loads(self, data: bytes) -> Any:
        """Load plain data from bytes. Raise `pickle.UnpicklingError` if they contain anything else."""
        return self.load(io.BytesIO(data))


def _load(
    file: Path,
    opened: Callable[..., Any],
    allowed: set[tuple[str, str]],
    moved: Mapping[str, str] | None = None,
) -> Any:
    try:
        with opened(file, "rb") as source, warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="dtype.*align")  # written by an older numpy
            content = _Unpickler(source, allowed, moved).load()
            source.read(1)  # a gzip's checksum is compared at its end
            return content
    except Exception as error:  # a damaged pickle can raise any error
        raise InputError(f"{file}: cannot read it as a pickle of plain data: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
