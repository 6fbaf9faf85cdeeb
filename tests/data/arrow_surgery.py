"""Damage a log's files on purpose."""

from collections.abc import Callable
from pathlib import Path

import msgpack
import pyarrow as pa


def rewrite_column(file: Path, column: str, change: Callable[[list], list]) -> None:
    """Replace the values of one column of an Arrow file, keeping its schema."""
    with pa.OSFile(str(file)) as source:
        table = pa.ipc.open_file(source).read_all()
    values = pa.array(change(table[column].to_pylist()), type=table.schema.field(column).type)
    index = table.schema.get_field_index(column)
    table = table.set_column(index, table.schema.field(column), values)
    with pa.OSFile(str(file), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)


def rewrite_metadata(file: Path, change: Callable[[dict], dict]) -> None:
    """Replace 123D's metadata of an Arrow file."""
    with pa.OSFile(str(file)) as source:
        table = pa.ipc.open_file(source).read_all()
    changed = change(msgpack.unpackb(table.schema.metadata[b"metadata"]))
    schema = table.schema.with_metadata({b"metadata": msgpack.packb(changed)})
    with pa.OSFile(str(file), "wb") as sink, pa.ipc.new_file(sink, schema) as writer:
        writer.write_table(table.cast(schema))
