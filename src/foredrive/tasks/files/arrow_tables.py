"""Tables of Arrow from outside: parquet and feather."""

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.parquet as parquet

from foredrive.errors import InputError


def read_table(path: Path, columns: Sequence[str]) -> pa.Table:
    """Return columns of a table in a parquet or feather file.

    Raises:
        InputError: it cannot be read, or lacks a column.
    """
    try:
        table = (parquet if path.suffix == ".parquet" else feather).read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{path}: not a table that can be read") from error
    missing = [name for name in columns if name not in table.column_names]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]}")
    return table.select(columns)
