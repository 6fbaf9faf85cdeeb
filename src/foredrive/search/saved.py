"""User data in an index: tags of moments, and named queries.

Both have their own tables, so they survive when a log is indexed again.
"""

from collections.abc import Iterable

import pyarrow as pa

from foredrive.files import naming
from foredrive.search.tables import all_rows, find_table, make_table, quoted, quoted_list

_TAGS = pa.schema([("tag", pa.string()), ("key", pa.string())])
_QUERIES = pa.schema([("name", pa.string()), ("query", pa.string())])


def add_tag(uri: str, tag: str, keys: Iterable[str]) -> None:
    """Add a tag to moments, given by their keys, in the index at `uri`."""
    rows = [{"tag": tag, "key": key} for key in sorted({*keys} - {*tagged(uri, tag)})]
    if rows:
        with naming(uri):
            make_table(uri, "tags", _TAGS).add(pa.Table.from_pylist(rows, schema=_TAGS))


def remove_tag(uri: str, tag: str) -> None:
    """Remove a tag from all moments."""
    table = find_table(uri, "tags")
    if table is not None:
        with naming(uri):
            table.delete(f"tag = {quoted(tag)}")


def tagged(uri: str, tag: str) -> list[str]:
    """Return the keys of the moments with a tag."""
    return [str(row["key"]) for row in all_rows(find_table(uri, "tags"), f"tag = {quoted(tag)}")]


def where_tagged(uri: str, tag: str) -> str:
    """Return an SQL condition for the moments with a tag."""
    keys = tagged(uri, tag)
    return f"key IN ({quoted_list(keys)})" if keys else "false"


def save_query(uri: str, name: str, query: str) -> None:
    """Save a query. It replaces a query of the same name."""
    with naming(uri):
        # One transaction, so that the older query is there until the new one is
        replacing = make_table(uri, "queries", _QUERIES).merge_insert("name")
        replacing.when_matched_update_all().when_not_matched_insert_all().execute(
            pa.Table.from_pylist([{"name": name, "query": query}], schema=_QUERIES)
        )


def saved_queries(uri: str) -> dict[str, str]:
    """Return the saved queries by name."""
    return {str(row["name"]): str(row["query"]) for row in all_rows(find_table(uri, "queries"))}
