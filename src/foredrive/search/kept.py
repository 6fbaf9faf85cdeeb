"""What users keep in an index: tags on moments, and queries by name.

Both lie in tables of their own: they outlast a log's being indexed anew.
"""

from collections.abc import Iterable

import pyarrow as pa

from foredrive.files import naming
from foredrive.search.tables import all_rows, find_table, make_table, quoted, quoted_list

_TAGS = pa.schema([("tag", pa.string()), ("key", pa.string())])
_QUERIES = pa.schema([("name", pa.string()), ("query", pa.string())])


def add_tag(uri: str, tag: str, keys: Iterable[str]) -> None:
    """Give moments of the index at `uri`, by their keys, a tag; those that have it keep it."""
    rows = [{"tag": tag, "key": key} for key in sorted({*keys} - {*tagged(uri, tag)})]
    if rows:
        with naming(uri):
            make_table(uri, "tags", _TAGS).add(pa.Table.from_pylist(rows, schema=_TAGS))


def remove_tag(uri: str, tag: str) -> None:
    """Take a tag away from all that have it."""
    table = find_table(uri, "tags")
    if table is not None:
        with naming(uri):
            table.delete(f"tag = {quoted(tag)}")


def tagged(uri: str, tag: str) -> list[str]:
    """The keys of the moments that have a tag."""
    return [str(row["key"]) for row in all_rows(find_table(uri, "tags"), f"tag = {quoted(tag)}")]


def where_tagged(uri: str, tag: str) -> str:
    """A condition that holds for the moments that have a tag."""
    keys = tagged(uri, tag)
    return f"key IN ({quoted_list(keys)})" if keys else "false"


def save_query(uri: str, name: str, query: str) -> None:
    """Keep a query, in place of one of the same name."""
    with naming(uri):
        table = make_table(uri, "queries", _QUERIES)
        table.delete(f"name = {quoted(name)}")
        table.add(pa.Table.from_pylist([{"name": name, "query": query}], schema=_QUERIES))


def saved_queries(uri: str) -> dict[str, str]:
    """Queries that were kept, by name."""
    return {str(row["name"]): str(row["query"]) for row in all_rows(find_table(uri, "queries"))}
