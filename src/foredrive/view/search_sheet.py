"""The hits of a search as a picture, as HTML, and as a table."""

from collections.abc import Sequence
from pathlib import Path

from foredrive.errors import InputError
from foredrive.search.find import Hit
from foredrive.search.query import Modality, Query
from foredrive.view import palette
from foredrive.view.hit_picture import (
    GAP_PX,
    HEIGHT_PX,
    WIDTH_PX,
    content_text,
    hit_name,
    hit_picture,
    score_text,
)
from foredrive.view.html import picture, write_page
from foredrive.view.sheet import Sheet
from foredrive.view.table import Column, Table, simple_table

COLUMNS = 3
MARGIN_PX, HEAD_PX, TEXT_PX = 16, 54, 62
CELL_PX = WIDTH_PX + GAP_PX + HEIGHT_PX
LINE_PX = 17
MAX_ON_PICTURE = 60
UNLIKE = "   no hits: the nearest moments"
SENSORS: dict[Modality, str] = {"image": "images", "lidar": "lidar", "joint": "images and lidar"}


def write_search_sheet(path: Path, query: Query, hits: Sequence[Hit], unlike: bool = False) -> None:
    """Write the hits in their order, three per row.

    Args:
        path: ends in .png (a picture of the first 60) or .html (all hits, in one file that loads no other).
        unlike: whether the hits are only the nearest moments, see `Found.unlike`; the title says so.

    Raises:
        InputError: the path has another suffix.
    """
    check_sheet(path)
    title = query_line(query) + (UNLIKE if unlike else "")
    if path.suffix == ".png":
        _write_picture(path, title, hits[:MAX_ON_PICTURE])
        return
    shown = [
        (picture(hit_picture(hit), f"{number}   {hit_name(hit)}"), score_text(hit), _hit_lines(hit))
        for number, hit in enumerate(hits, 1)
    ]
    write_page(path, "search_sheet.html.j2", title=title, hits=shown)


def check_sheet(path: Path) -> None:
    """Check that a contact sheet can be written under this name.

    Raises:
        InputError: the name ends neither in .png nor in .html.
    """
    if path.suffix not in (".png", ".html"):
        raise InputError(f"{path}: a contact sheet ends on .png or .html")


def query_line(query: Query) -> str:
    """Return a query as one line of text."""
    asked = [f"“{text}”" for text in (query.text, query.image_text, query.lidar_text) if text]
    asked += [f"like {query.like}"] if query.like else []
    if asked:
        asked.append(
            f"by {SENSORS[query.modality]}" + ("" if query.rule == "features" else f" ({query.rule})")
        )
    asked += [f"where {query.where}"] if query.where else []
    asked += [f"tagged {query.tag}"] if query.tag else []
    asked += [f"ranked by {query.by}"] if query.by else []
    asked += [f"diverse ({query.diverse})"] if query.diverse else []
    return "   ".join(asked)


def _write_picture(path: Path, title: str, hits: Sequence[Hit]) -> None:
    rows = -(-len(hits) // COLUMNS)
    width = MARGIN_PX + min(len(hits), COLUMNS) * (CELL_PX + MARGIN_PX)
    sheet = Sheet(width, HEAD_PX + rows * (HEIGHT_PX + TEXT_PX))
    sheet.head(MARGIN_PX, HEAD_PX, title, 15.0)
    for number, hit in enumerate(hits):
        x = MARGIN_PX + number % COLUMNS * (CELL_PX + MARGIN_PX)
        y = HEAD_PX + number // COLUMNS * (HEIGHT_PX + TEXT_PX)
        ax = sheet.place(x, y, CELL_PX, HEIGHT_PX)
        ax.imshow(hit_picture(hit), interpolation="none", aspect="auto")
        ax.set_axis_off()
        below = y + HEIGHT_PX + 4
        sheet.write(x, below, f"{number + 1}   {hit_name(hit)}", 10.0)
        sheet.write(x, below + LINE_PX, score_text(hit), 9.0, palette.EXPERT)
        sheet.write(x, below + 2 * LINE_PX, content_text(hit), 9.0, palette.FAINT)
    sheet.save(path)


def hits_table(hits: Sequence[Hit]) -> Table:
    """Return the hits as a table."""
    columns = (
        Column(),
        Column("moment and view", align="left", wraps=False),  # Users copy it into --like
        Column("score", align="left", wraps=False),
        Column("content", align="left"),
    )
    rows = [(n, hit_name(hit), score_text(hit), content_text(hit)) for n, hit in enumerate(hits, 1)]
    return simple_table(columns, rows)


def _hit_lines(hit: Hit) -> list[str]:
    return [content_text(hit)] + ([] if hit.row.caption is None else [hit.row.caption])
