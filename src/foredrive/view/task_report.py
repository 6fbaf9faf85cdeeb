"""Tables and a page of the figures of a task, under each of its protocols."""

from collections.abc import Callable, Sequence
from pathlib import Path

from foredrive.evaluation.summary import Summary
from foredrive.view.html import write_page
from foredrive.view.map_tables import map_tables
from foredrive.view.motion_tables import motion_tables
from foredrive.view.object_tables import detection_tables, tracking_tables
from foredrive.view.occupancy_tables import occupancy_tables
from foredrive.view.summary_tables import full_table
from foredrive.view.table import Table

TABLES: dict[str, Callable[[Summary], Sequence[Table]]] = {
    "detection": detection_tables,
    "map": map_tables,
    "motion": motion_tables,
    "occupancy": occupancy_tables,
    "tracking": tracking_tables,
}
"""Tables of a summary, the main one first, by task."""


def task_tables(figures: Summary) -> Sequence[Table]:
    """Return the tables of the task that a summary states."""
    return TABLES[str(figures["task"])](figures)


def write_task_report(path: Path, title: str, figures: Summary) -> None:
    """Write a page with the tables and all figures."""
    page = "task_report.html.j2"
    write_page(path, page, title=title, tables=task_tables(figures), all_metrics=full_table(figures))
