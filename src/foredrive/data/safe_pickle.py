"""Reading of untrusted pickles without running their code, in memory proportional to their size.

Some names that arrays and tables need can be called with other arguments than pandas and NumPy write:
`ndarray((10**10,))`, `DataFrame(0, RangeIndex(10**9))`, or `encode` repeatedly on its own result. Here
classes are replaced by objects that cannot be called, and functions check their arguments.
"""

import functools
import gzip
import importlib
import io
import pickle
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy._core import multiarray

from foredrive.errors import InputError

MAX_UNZIPPED_BYTES = 2**26
"""Size of the largest gzipped pickle. A sweep of PandaSet has 9 MB."""
MAX_ROWS = 10**7
"""Maximum number of rows of a table whose index is a range, which takes no bytes in the file."""

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
    ("pandas", "DataFrame"),  # Of pandas 3; earlier versions name the defining module
    ("pandas", "Index"),
    ("pandas", "RangeIndex"),
    ("pandas.core.frame", "DataFrame"),
    ("pandas.core.internals.managers", "BlockManager"),
    ("pandas._libs.internals", "_unpickle_block"),
    ("pandas.core.indexes.base", "Index"),
    ("pandas.core.indexes.base", "_new_Index"),
    ("pandas.core.indexes.range", "RangeIndex"),
    # Indexes of numbers of pandas before 2
    ("pandas.core.indexes.numeric", "Int64Index"),
    ("pandas.core.indexes.numeric", "UInt64Index"),
    ("pandas.core.indexes.numeric", "Float64Index"),
    # Texts of pandas 3, which are arrays of Arrow
    ("pandas", "StringDtype"),
    ("pandas.arrays", "ArrowStringArray"),
    ("pyarrow.lib", "_restore_array"),
    ("pyarrow.lib", "py_buffer"),
    ("pyarrow.lib", "type_for_alias"),
    ("builtins", "bytearray"),
    ("builtins", "bytes"),
}
"""Names that a pickled pandas table of numbers and strings needs in addition."""


class _Unpickler(pickle.Unpickler):
    def __init__(
        self, source: Any, allowed: set[tuple[str, str]], moved: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(source)
        self._allowed, self._moved = allowed, moved or {}

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core.", "numpy._core.")  # The name before numpy 2
        module = "builtins" if module == "__builtin__" else self._moved.get(module, module)  # Of protocol 2
        if (module, name) not in self._allowed:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which plain data do not need")
        if name == "DataFrame":
            return _table_class()
        if name in _CHECKED:
            return _CHECKED[name]
        return getattr(importlib.import_module(module), name)


class _StandIn:
    """Takes the place of a class that a pickle may name, but not call."""


_NDARRAY, _INDEX, _RANGE = _StandIn(), _StandIn(), _StandIn()


def _reconstruct(kind: object, shape: object, dtype: object) -> Any:
    """Return an empty array. Its shape and bytes follow in the pickle, and NumPy compares their sizes."""
    if kind is not _NDARRAY or shape != (0,):
        raise pickle.UnpicklingError("an array is not as NumPy writes it")
    return multiarray._reconstruct(np.ndarray, (0,), dtype)


def _scalar(dtype: Any, content: object) -> Any:
    """Return a number. Without content, it would have as many bytes as its type says."""
    return multiarray.scalar(dtype, content)


def _encode(text: str, encoding: str) -> bytes:
    """Return bytes that protocols before 3 write as text."""
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes are not as Python writes them ({encoding!r})"[:100])
    return text.encode("latin1")


def _new_index(kind: object, state: dict[str, Any]) -> Any:
    """Return the index of a table, which is a range or has its values."""
    if kind is _RANGE:
        index = pd.RangeIndex(state["start"], state["stop"], state["step"], name=state.get("name"))
        if len(index) <= MAX_ROWS:
            return index
    elif kind is _INDEX:
        data = _plain_values(state["data"])
        if isinstance(data, np.ndarray | pd.api.extensions.ExtensionArray):
            return pd.Index(data, dtype=data.dtype, name=state.get("name"))
    raise pickle.UnpicklingError("the index of a table is not as pandas writes it")


class _Texts:
    """Takes the place of pandas' array of Arrow texts until its state is there."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.values, self.dtype = state["_pa_array"], state["_dtype"]
        if not isinstance(self.values, pa.ChunkedArray | pa.Array) or not isinstance(
            self.dtype, pd.StringDtype
        ):
            raise pickle.UnpicklingError("an array of texts is not as pandas writes it")


def _plain_values(values: Any) -> Any:
    return pd.array(values.values.to_pylist(), dtype=values.dtype) if isinstance(values, _Texts) else values


def _block(values: Any, placement: Any, ndim: int) -> Any:
    """Return a part of a table."""
    from pandas._libs.internals import _unpickle_block

    return _unpickle_block(_plain_values(values), placement, ndim)


def _text_type(storage: str = "pyarrow", na_value: Any = np.nan) -> "pd.StringDtype":
    return pd.StringDtype(storage, na_value)


def _arrow_type(alias: str) -> Any:
    if alias not in ("string", "large_string"):
        raise pickle.UnpicklingError(
            f"an array of Arrow has the type {alias!r:.50}, which plain tables do not need"
        )
    return pa.type_for_alias(alias)


def _arrow_texts(state: tuple[Any, ...]) -> Any:
    """Return an array of Arrow. It is checked as a whole: its offsets could point out of its bytes."""
    kind, length, null_count, offset, buffers, children, dictionary = state
    if children or dictionary is not None:
        raise pickle.UnpicklingError("an array of texts is not as Arrow writes it")
    array = pa.Array.from_buffers(kind, length, buffers, null_count, offset)
    array.validate(full=True)
    return array


def _bytearray(content: bytes | str = b"", encoding: str = "latin1") -> bytearray:
    """Return bytes. A number would be the size of empty ones."""
    return bytearray(_encode(content, encoding) if isinstance(content, str) else memoryview(content))


def _no_bytes() -> bytes:
    """Return what protocols before 3 write for no bytes."""
    return b""


def _buffer(content: object) -> Any:
    if not isinstance(content, bytes | bytearray):
        raise pickle.UnpicklingError("a buffer of Arrow has no bytes")
    return pa.py_buffer(content)


@functools.cache
def _table_class() -> type:
    """Return the class of a table that is restored only from its unpickled state.

    It is defined at the first use, because logs are opened without pandas, which is slow to import.
    """

    class Table(pd.DataFrame):
        def __init__(self, *args: object, **options: object) -> None:
            raise pickle.UnpicklingError("a table is not as pandas writes it")

    return Table


_CHECKED: Mapping[str, Any] = {
    "ndarray": _NDARRAY,
    "Index": _INDEX,
    "RangeIndex": _RANGE,
    "_reconstruct": _reconstruct,
    "scalar": _scalar,
    "encode": _encode,
    "_new_Index": _new_index,
    "Int64Index": _INDEX,
    "UInt64Index": _INDEX,
    "Float64Index": _INDEX,
    "_unpickle_block": _block,
    "StringDtype": _text_type,
    "ArrowStringArray": _Texts,
    "_restore_array": _arrow_texts,
    "type_for_alias": _arrow_type,
    "py_buffer": _buffer,
    "bytearray": _bytearray,
    "bytes": _no_bytes,
}
"""Replacements by allowed name. Other allowed names cannot allocate more memory than they are given."""


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
    try:
        return pd.DataFrame(table, copy=False)
    except AttributeError as error:  # A pickle can create a table without its content
        raise InputError(f"{file}: a table without content") from error


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
    """The functions of the module `pickle`, limited to plain data. It replaces `pickle` in a library.

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
            warnings.filterwarnings("ignore", message="dtype.*align")  # Written by an older numpy
            if opened is gzip.open:
                unzipped = source.read(MAX_UNZIPPED_BYTES + 1)  # To the end, where gzip checks the checksum
                if len(unzipped) > MAX_UNZIPPED_BYTES:
                    raise ValueError(f"longer than {MAX_UNZIPPED_BYTES:,} bytes")
                source = io.BytesIO(unzipped)
            return _Unpickler(source, allowed, moved).load()
    except Exception as error:  # A damaged pickle can raise any error
        raise InputError(f"{file}: cannot read it as a pickle of plain data: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
