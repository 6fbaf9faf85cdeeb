"""What users keep in an index: tags on moments, and queries by name.

Both lie in tables of their own: they outlast a log's being indexed anew.
"""

from collections.abc import Iterable

import pyarrow as pa

from foredrive.search.tables import all_rows, find_table, make_table, quoted

_TAGS = pa.schema([("tag", pa.string()), ("log", pa.string()), ("t_us", pa.int64())])
_QUERIES = pa.schema([("name", pa.string()), ("query", pa.string())])
Moment = tuple[str, int]
"""A log's name, and a time of it in µs."""


def add_tag(uri: str, tag: str, moments: Iterable[Moment]) -> None:
    """Give moments of the index at `uri` a tag; those that have it keep it."""
    rows = [
        {"tag": tag, "log": log, "t_us": t_us}
        for log, t_us in sorted({*moments} - {*tagged(uri, tag)})
    ]  # fmt: skip
    if rows:
        make_table(uri, "tags", _TAGS).add(pa.Table.from_pylist(rows, schema=_TAGS))


def remove_tag(uri: str, tag: str) -> None:
    """Take a tag away from all that have it."""
    table = find_table(uri, "tags")
    if table is not None:
        table.delete(f"tag = {quoted(tag)}")


def tagged(uri: str, tag: str) -> list[Moment]:
    """The moments that have a tag."""
    rows = all_rows(find_table(uri, "tags"), f"tag = {quoted(tag)}")
    return [(str(row["log"]), int(str(row["t_us"]))) for row in rows]


def where_tagged(uri: str, tag: str) -> str:
    """A condition that holds for the moments that have a tag."""
    of_log: dict[str, list[str]] = {}
    for log, t_us in tagged(uri, tag):
        of_log.setdefault(log, []).append(str(t_us))
    each = [f"(log = {quoted(log)} AND t_us IN ({', '.join(times)}))" for log, times in of_log.items()]
    return f"({' OR '.join(each)})" if each else "false"


def save_query(uri: str, name: str, query: str) -> None:
    """Keep a query, in place of one of the same name."""
    table = make_table(uri, "queries", _QUERIES)
    table.delete(f"name = {quoted(name)}")
    table.add(pa.Table.from_pylist([{"name": name, "query": query}], schema=_QUERIES))


def saved_queries(uri: str) -> dict[str, str]:
    """Queries that were kept, by name."""
    return {str(row["name"]): str(row["query"]) for row in all_rows(find_table(uri, "queries"))}
