"""The hits of a search on one page, as a picture or as HTML, and as a table in the terminal."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.search.find import Hit
from foredrive.search.query import Query
from foredrive.view import palette
from foredrive.view.hit_picture import (
    GAP_PX,
    HEIGHT_PX,
    WIDTH_PX,
    hit_name,
    hit_picture,
    what_is_there,
    why_matched,
)
from foredrive.view.html import picture, write_page
from foredrive.view.table import Column, Table, simple_table

DPI = 100
COLUMNS = 3
MARGIN_PX, HEAD_PX, TEXT_PX = 16, 54, 62
CELL_PX = WIDTH_PX + GAP_PX + HEIGHT_PX
MOST_ON_PICTURE = 60
TITLE_PT = 15.0


def write_search_sheet(path: Path, query: Query, hits: Sequence[Hit]) -> None:
    """Write the hits in their order, three a row.

    Args:
        path: ends on .png (a picture of the first 60) or .html (all, in one file that loads nothing).

    Raises:
        InputError: it ends otherwise.
    """
    check_sheet(path)
    if path.suffix == ".png":
        figure = draw_search_sheet(query, hits[:MOST_ON_PICTURE])
        with atomic_path(path) as scratch:
            figure.savefig(scratch, dpi=DPI, facecolor=palette.GROUND, format="png")
        return
    shown = [
        (picture(hit_picture(hit), f"{number}   {hit_name(hit)}"), why_matched(hit), _told(hit))
        for number, hit in enumerate(hits, 1)
    ]
    write_page(path, "search_sheet.html.j2", title=query_line(query), hits=shown)


def check_sheet(path: Path) -> None:
    """Whether a contact sheet can be written under this name.

    Raises:
        InputError: it ends neither on .png nor on .html.
    """
    if path.suffix not in (".png", ".html"):
        raise InputError(f"{path}: a contact sheet ends on .png or .html")


def query_line(query: Query) -> str:
    """A query in one line."""
    asked = [f"“{text}”" for text in (query.text, query.image_text, query.lidar_text) if text]
    asked += [f"like {query.like}"] if query.like else []
    if asked:
        asked.append(f"by {query.modality}" + (f" ({query.rule})" if query.modality == "joint" else ""))
    asked += [f"where {query.where}"] if query.where else []
    asked += [f"tagged {query.tag}"] if query.tag else []
    asked += [f"ranked by {query.by}"] if query.by else []
    asked += [f"diverse ({query.diverse})"] if query.diverse else []
    return "   ".join(asked)


def draw_search_sheet(query: Query, hits: Sequence[Hit]) -> Figure:
    """The picture as a figure."""
    rows = -(-len(hits) // COLUMNS)
    width = MARGIN_PX + min(len(hits), COLUMNS) * (CELL_PX + MARGIN_PX)
    height = HEAD_PX + rows * (HEIGHT_PX + TEXT_PX)
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor=palette.GROUND)
    title = query_line(query)
    size_pt = min(TITLE_PT, 1.15 * width / max(len(title), 1))  # long ones shrink to fit
    at = 1 - HEAD_PX / 2 / height
    figure.text(MARGIN_PX / width, at, title, color=palette.INK, fontsize=size_pt, va="center")
    for number, hit in enumerate(hits):
        x = MARGIN_PX + number % COLUMNS * (CELL_PX + MARGIN_PX)
        y = HEAD_PX + number // COLUMNS * (HEIGHT_PX + TEXT_PX)
        box = (x / width, 1 - (y + HEIGHT_PX) / height, CELL_PX / width, HEIGHT_PX / height)
        ax = figure.add_axes(box)
        ax.imshow(hit_picture(hit), interpolation="none", aspect="auto")
        ax.set_axis_off()
        lines = (
            (f"{number + 1}   {hit_name(hit)}", palette.INK, 10.0),
            (why_matched(hit), palette.EXPERT, 9.0),
        )
        for line, (text, colour, size) in enumerate((*lines, (what_is_there(hit), palette.FAINT, 9.0))):
            below = 1 - (y + HEIGHT_PX + 4 + 17 * line) / height
            figure.text(x / width, below, text, color=colour, fontsize=size, va="top")
    return figure


def hits_table(hits: Sequence[Hit]) -> Table:
    """List the hits."""
    columns = (
        Column(),
        *(Column(name, align="left") for name in ("moment and view", "why", "what is there")),
    )
    rows = [(n, hit_name(hit), why_matched(hit), what_is_there(hit)) for n, hit in enumerate(hits, 1)]
    return simple_table(columns, rows)


def _told(hit: Hit) -> list[str]:
    caption = hit.facts["caption"]
    return [what_is_there(hit)] + ([] if caption is None else [str(caption)])
