"""Damage a log's files on purpose."""

from collections.abc import Callable
from pathlib import Path

import msgpack
import pyarrow as pa


def rewrite_column(
    file: Path, column: str, change: Callable[[list], list], type_: pa.DataType | None = None
) -> None:
    """Replace the values of one column of an Arrow file, keeping its schema, but for a new type if given."""
    with pa.OSFile(str(file)) as source:
        table = pa.ipc.open_file(source).read_all()
    index = table.schema.get_field_index(column)
    field = table.schema.field(column) if type_ is None else table.schema.field(column).with_type(type_)
    values = pa.array(change(table[column].to_pylist()), type=field.type)
    table = table.set_column(index, field, values)
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
