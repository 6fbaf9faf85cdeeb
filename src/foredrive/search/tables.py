"""The LanceDB functions that an index needs. LanceDB is imported late, and only here."""

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from foredrive.errors import InputError
from foredrive.files import make_folder

if TYPE_CHECKING:
    from lancedb import DBConnection
    from lancedb.table import Table

_TROUBLE = (ValueError, RuntimeError, OSError)
"""Exception types of LanceDB, for its own errors, those of a query and those of a disk alike."""


def connect(uri: str) -> "DBConnection":
    """Connect to the tables in a folder or on object storage ("s3://…"), whose credentials are set elsewhere.

    Raises:
        InputError: LanceDB is not installed.
    """
    try:
        import lancedb
    except ImportError:
        raise InputError("an index needs LanceDB: pip install lancedb") from None
    return lancedb.connect(uri)


def find_table(uri: str, name: str) -> "Table | None":
    """Return an existing table, or None. Nothing is written.

    Raises:
        InputError: the table cannot be read.
    """
    # Opening a database in a local folder would create the folder
    if "://" not in uri and not (Path(uri) / f"{name}.lance").exists():
        return None
    try:
        return connect(uri).open_table(name)
    except _TROUBLE as error:
        if "not found" in str(error).lower():
            return None
        raise InputError(f"{uri}: the table {name} cannot be read: {first_line(error)}") from error


def make_table(uri: str, name: str, schema: pa.Schema) -> "Table":
    """Return a table. It is created if it does not exist.

    Raises:
        InputError: no folder can be made there.
        OSError: the operating system refuses it.
    """
    if "://" not in uri:
        make_folder(Path(uri))
    return connect(uri).create_table(name, schema=schema, exist_ok=True)


def all_rows(table: "Table | None", where: str | None = None) -> list[dict[str, object]]:
    """Return all rows of a small table."""
    if table is None:
        return []
    query = table.search() if where is None else table.search().where(where)
    rows: list[dict[str, object]] = query.limit(None).to_arrow().to_pylist()
    return rows


@contextlib.contextmanager
def understanding(where: str | None) -> Iterator[None]:
    """Convert LanceDB's errors about the condition `where` into an `InputError` of one line.

    Raises:
        InputError: LanceDB rejects the condition.
    """
    try:
        yield
    except _TROUBLE as error:
        if where is None:
            raise
        raise InputError(f"the condition {where!r} cannot be understood: {first_line(error)}") from error


def first_line(error: BaseException) -> str:
    """Return the first line of LanceDB's message, without the position in its source code."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].split(", rust/")[0]


def quoted_list(texts: Iterable[str]) -> str:
    """Return texts as an SQL list."""
    return ", ".join(map(quoted, texts))


def quoted(text: str) -> str:
    """Return a text as an SQL literal."""
    return "'" + text.replace("'", "''") + "'"
