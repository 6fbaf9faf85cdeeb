"""A table as data, for the terminal and for reports."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text

from foredrive.engine.summary import Value

MISSING = "\N{EN DASH}"
MIN_TEXT_WIDTH, MAX_WIDTH = 16, 1000
"""Minimum width of a column of words, and maximum width of a table in the terminal, in characters."""
RICH_STYLES = {"": "", "best": "green", "good": "green", "bad": "bold yellow"}


@dataclass(frozen=True)
class Column:
    """A column: its titles and the format of its values.

    Args:
        title: title of this column.
        group: a title shared with the neighbouring columns of the same group.
        digits: digits of a float after the decimal point.
        align: left for words, right for numbers.
        wraps: whether the terminal may wrap long words. Titles of rows and numbers never wrap.
    """

    title: str = ""
    group: str = ""
    digits: int = 3
    align: Literal["left", "right"] = "right"
    wraps: bool = True


@dataclass(frozen=True)
class Cell:
    """A value that is highlighted, or that links to an anchor of the page."""

    value: Value
    mark: Literal["", "best", "good", "bad"] = ""
    link: str = ""


@dataclass(frozen=True)
class Row:
    """A row; its first cell is its title."""

    cells: Sequence[Value | Cell]
    is_strong: bool = False


@dataclass(frozen=True)
class Section:
    """Rows under their own title, separated from the rows above."""

    rows: Sequence[Row]
    title: str = ""


@dataclass(frozen=True)
class Table:
    """A table; the first column holds the rows' titles."""

    columns: Sequence[Column]
    sections: Sequence[Section]
    title: str = ""
    notes: Sequence[str] = ()

    @property
    def has_head(self) -> bool:
        """Return whether any column has a title."""
        return any(column.title or column.group for column in self.columns)

    @property
    def groups(self) -> list[tuple[str, list[Column]]]:
        """Return neighbouring columns by their group."""
        return [(group, list(columns)) for group, columns in itertools.groupby(self.columns, _group)]


def simple_table(columns: Sequence[Column], rows: Sequence[Sequence[Value | Cell]], title: str = "") -> Table:
    """Return a table of one section without notes."""
    return Table(columns, [Section([Row(cells) for cells in rows])], title)


def number(value: Value, digits: int = 3) -> str:
    """Return a value as text: a float with `digits` after the decimal point, a missing value as a dash."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return MISSING
    return f"{value:z.{digits}f}" if isinstance(value, float) else str(value)


def words(name: str) -> str:
    """Return an identifier as words."""
    return str(name).replace("_", " ")


def print_table(table: Table, console: Console) -> None:
    """Print a table and its notes. A console that is too narrow for the numbers is widened."""
    shown = _rich(table)
    # Measured with room to spare: in a narrow console rich would shorten the numbers
    wide = console.options.update(max_width=MAX_WIDTH)
    console.width = max(console.width, Measurement.get(console, wide, shown).minimum)
    console.print(shown)
    for note in table.notes:
        console.print(Text(note, style="dim"))


def _rich(table: Table) -> RichTable:
    """Return the table for rich; no text in it is read as markup."""
    shown = RichTable(
        title=Text(table.title) if table.title else None,
        title_justify="left",
        header_style="bold",
        box=box.SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
        show_header=table.has_head,
    )
    grouped = any(column.group for column in table.columns)
    heads = [
        f"{group if place == 0 else ''}\n{column.title}" if grouped else column.title
        for group, columns in table.groups
        for place, column in enumerate(columns)
    ]
    for column, head in zip(table.columns, heads, strict=True):
        shown.add_column(Text(head), justify=column.align, overflow="fold", min_width=MIN_TEXT_WIDTH)
    for section in table.sections:
        if section.title:
            shown.add_row(Text(section.title, style="dim"))
        for row in section.rows:
            shown.add_row(*map(_rich_cell, row.cells, table.columns), style="bold" if row.is_strong else None)
        shown.add_section()
    # Titles of rows and numbers get the width of their longest line, so that only texts wrap
    for place, (made, column) in enumerate(zip(shown.columns, table.columns, strict=True)):
        if place == 0 or column.align == "right" or not column.wraps:
            lines = [line for cell in (made.header, *made.cells) for line in str(cell).split("\n")]
            made.no_wrap, made.min_width = True, max(map(cell_len, lines))
    return shown


def _rich_cell(cell: Value | Cell, column: Column) -> Text:
    cell = cell if isinstance(cell, Cell) else Cell(cell)
    return Text(number(cell.value, column.digits), style=RICH_STYLES[cell.mark])


def _group(column: Column) -> str:
    return column.group
