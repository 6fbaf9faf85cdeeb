"""Tables in the terminal, and as parts of pages."""

import io

from html_pages import EVIL, Page
from rich.console import Console

from foredrive.view.html import render_page
from foredrive.view.table import Cell, Column, Row, Section, Table, print_table, simple_table


def printed(table: Table, width: int = 80) -> list[str]:
    stream = io.StringIO()
    print_table(table, Console(file=stream, width=width))
    return [line.rstrip() for line in stream.getvalue().splitlines()]


def grouped() -> Table:
    return Table(
        columns=[Column(align="left"), Column("1s", "L2", 2), Column("2s", "L2", 2), Column("frames")],
        sections=[
            Section([Row(["model", 1.0, Cell(0.5, "best"), 7], is_strong=True)], "first"),
            Section([Row(["other", None, 2.0, 8])], "second"),
        ],
        title="Planning",
        notes=["Green: the best."],
    )


def test_groups_sections_and_notes_in_the_terminal() -> None:
    words = [line.split() for line in printed(grouped()) if line.split()]
    assert words[:3] == [["Planning"], ["L2"], ["1s", "2s", "frames"]]
    assert words[4:] == [
        ["first"],
        ["model", "1.00", "0.50", "7"],
        ["second"],
        ["other", "\N{EN DASH}", "2.00", "8"],
        ["Green:", "the", "best."],
    ]


def test_a_narrow_terminal_folds_words_and_never_cuts_numbers() -> None:
    columns = [Column("name", align="left"), Column("number", digits=9), Column("what", align="left")]
    lines = printed(simple_table(columns, [["a" * 30, 1 / 3, "word " * 20]]), width=20)
    assert "a" * 30 + "  0.333333333" in "\n".join(lines)
    assert "\n".join(lines).count("word") == 20


def test_a_column_of_names_may_refuse_to_be_folded() -> None:
    columns = [Column("n"), Column("name", align="left", wraps=False), Column("what", align="left")]
    lines = printed(simple_table(columns, [[1, "a" * 60, "word " * 20]]), width=40)
    assert "a" * 60 in "\n".join(lines)


def test_square_brackets_are_no_markup() -> None:
    columns = [Column("[red]", align="left"), Column("b", align="left")]
    text = "\n".join(printed(simple_table(columns, [["[/nothing]", "[bold]x"]], "[title]")))
    assert all(name in text for name in ("[red]", "[/nothing]", "[bold]x", "[title]"))


def html_of(table: Table) -> Page:
    nothing = {"tiles": [], "diagrams": [], "frames": [], "all_metrics": table}
    return Page(render_page("score_report.html.j2", title="t", table=table, **nothing))


def test_a_page_marks_groups_sections_and_the_best() -> None:
    page = html_of(grouped())
    heads = [attributes for tag, attributes in page.tags if tag == "th"]
    assert {"class": "group", "colspan": "2"} in heads
    assert {"class": "text", "colspan": "4"} in heads  # a section's title
    assert heads.count({"rowspan": "2"}) == 2  # frames, here and in the full table
    assert ("tr", {"class": "strong"}) in page.tags
    assert ("td", {"class": "best"}) in page.tags


def test_every_text_of_a_table_is_escaped() -> None:
    column = Column(EVIL, EVIL)
    table = Table([column], [Section([Row([Cell(EVIL, link=EVIL)])], EVIL)], notes=[EVIL])
    page = html_of(table)
    assert "svg" not in {tag for tag, _ in page.tags}
    assert page.text.count(EVIL) == 2 * 5
