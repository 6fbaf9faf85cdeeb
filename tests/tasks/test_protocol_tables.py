"""The tables of docs/tasks.md are those that the protocols give."""

from pathlib import Path

from tasks.protocol_tables import map_rows, motion_rows

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"


def test_the_page_shows_what_the_protocols_give() -> None:
    lines = PAGE.read_text().splitlines()
    missing = [row for row in [*motion_rows(), *map_rows()] if row not in lines]
    assert not missing, "run tests/tasks/protocol_tables.py and put into docs/tasks.md:\n" + "\n".join(
        missing
    )
