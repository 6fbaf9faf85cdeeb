"""`foredrive search` and `search page`."""

from typing import TYPE_CHECKING

import tyro

from foredrive.cli.arguments import check_number
from foredrive.cli.search_options import (
    ConditionOptions,
    HitOptions,
    Name,
    Place,
    QueryOptions,
    RankingOptions,
    as_query,
    check_index,
)
from foredrive.errors import InputError
from foredrive.lazy import importing

if TYPE_CHECKING:
    from foredrive.search.find import Found
    from foredrive.search.index import FrameIndex
    from foredrive.search.query import Query

INDEX = "runs/search"


def search(
    query: tyro.conf.OmitArgPrefixes[QueryOptions],
    condition: tyro.conf.OmitArgPrefixes[ConditionOptions],
    ranking: tyro.conf.OmitArgPrefixes[RankingOptions],
    hits: tyro.conf.OmitArgPrefixes[HitOptions],
    index: Place = INDEX,
    towers: Name = None,
    saved: Name = None,
    untag: Name = None,
) -> None:
    """Find moments of indexed logs by a text, an example, their facts or their scores.

    Make the index with `foredrive search index LOGS`. `foredrive search page` queries it in the browser.

    Args:
        index: The index: a folder, or a location in object storage.
        towers: Current folder of the towers that made the index, if they have moved.
        saved: Run the query that was saved under this name; the other options of the query are ignored.
        untag: Remove this tag from all moments that have it; no search is done.
    """
    hits.check()
    check_index(index)
    # With a saved query or a tag to remove, the options of the query may be empty
    asked = as_query(query, condition, ranking) if saved is None and untag is None else None

    with importing():
        from foredrive.runs.search.searching import answer_notes, ask
        from foredrive.search.index import FrameIndex
        from foredrive.search.saved import remove_tag

    opened = FrameIndex(index)
    if untag is not None:
        remove_tag(index, untag)
        print(f"removed the tag {untag}")
        return
    if saved is not None:
        asked = _saved(index, saved)
    assert asked is not None
    result = ask(opened, asked, towers, ensemble=not query.plain)
    _print_found(opened, result, answer_notes(opened, asked, towers, result))
    hits.do(index, asked, result)


def search_page(index: Place = INDEX, towers: Name = None, host: str = "localhost", port: int = 8090) -> None:
    """Search in the browser: a grid of hits, conditions, and a map of all scenes with a lasso.

    Args:
        index: The index: a folder, or a location in object storage.
        towers: Current folder of the towers that made the index, if they have moved.
        host: Address at which the page is served; use 0.0.0.0 to make it visible to other machines.
        port: The page's port.
    """
    check_number("--port", port, low=1, high=65535)
    check_index(index)

    with importing():
        from foredrive.search.index import FrameIndex
        from foredrive.view.search_page import SearchPage

    page = SearchPage(FrameIndex(index), towers, host, port)
    print(f"serving the search page of {index} at {page.url}; press Ctrl-C to stop", flush=True)
    page.server.serve()


def _saved(index: str, name: str) -> "Query":
    from foredrive.search.query import Query
    from foredrive.search.saved import saved_queries

    saved = saved_queries(index)
    if name not in saved:
        raise InputError(f"{index}: no saved query {name}; there are: {', '.join(saved) or 'none'}")
    return Query.from_json(saved[name])


def _print_found(index: "FrameIndex", result: "Found", notes: list[str]) -> None:
    from rich.console import Console

    from foredrive.view.search_sheet import hits_table
    from foredrive.view.table import print_table

    rows = index.count()
    if not result.hits:
        print(f"nothing found among {rows} rows of {index.uri}")
        return
    print_table(hits_table(result.hits), Console())
    for note in notes:
        print(note)
    how = "all compared" if result.exact else f"{result.compared} compared, the others are less similar"
    what = "moments, no hits," if result.unlike else "hits"
    print(f"{len(result.hits)} {what} among {rows} rows of {index.uri}; {how}")
