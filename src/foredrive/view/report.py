"""One self-contained page about a run: metrics, tables, curves and example panels."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.view.example_panel import ExamplePanel, show_panel
from foredrive.view.html import MetricTile, write_page
from foredrive.view.loss_curves import Losses, draw_loss_curves
from foredrive.view.origin import Provenance
from foredrive.view.summary_tables import (
    PRIOR,
    flow_table,
    full_table,
    image_table,
    occupancy_table,
    planning_overview,
    planning_table,
    ratio_to_prior,
)
from foredrive.view.table import Summary, Value, number, words

COMMAND_SOURCES = {
    "route": "the log's route",
    "driven_future": "the driven future, which leaks part of the answer",
    "none": "nowhere",
}
REFERENCE = "constant_velocity"


@dataclass(frozen=True)
class ReportData:
    """The content of a report; a part without content is left out."""

    title: str
    origin: Provenance
    summary: Summary
    losses: Losses
    panels: Sequence[ExamplePanel]
    notes: Sequence[str] = ()
    """Facts that a reader needs in order to interpret the metrics correctly."""


@dataclass(frozen=True)
class Alert:
    """A line that a reader must not overlook; a strong one stands out."""

    text: str
    is_strong: bool = False


def write_report(path: Path, report: ReportData) -> None:
    """Write the page."""
    summary = report.summary
    tables = (occupancy_table(summary), flow_table(summary), image_table(summary))
    write_page(
        path,
        "run_report.html.j2",
        title=report.title,
        origin=report.origin,
        alerts=_alerts(report),
        tiles=_tiles(summary),
        planning_overview=planning_overview(summary),
        planning=planning_table(summary),
        tables=[table for table in tables if table is not None],
        curves=draw_loss_curves(report.losses),
        panels=[show_panel(panel) for panel in report.panels],
        every_figure=full_table(summary),
    )


def _alerts(report: ReportData) -> list[Alert]:
    """Return lines about failed items, the sources of the commands, and the notes."""
    alerts = []
    for key, count in report.summary.items():
        if key == "failed" or (key.endswith(".failed") and count):
            who = "this model" if key == "failed" else words(key.split(".")[-2])
            alerts.append(Alert(f"Failed items of {who}: {number(count)}.", bool(count)))
    for source, title in COMMAND_SOURCES.items():
        if count := report.summary.get(f"command_source.{source}"):
            alerts.append(Alert(f"Commands taken from {title}: {number(count)}.", source == "driven_future"))
    return alerts + [Alert(note) for note in report.notes]


def _tiles(summary: Summary) -> list[MetricTile]:
    """Return tiles of the main metrics."""
    tiles = []

    def add(name: str, value: Value, digits: int, unit: str = "", note: str = "") -> None:
        if value is not None:
            tiles.append(MetricTile(name, number(value, digits), unit, note))

    for scope, title in (("above_ground.", "above ground"), ("", "all")):
        key = f"occupancy.{scope}iou_now"
        ratio, constant = ratio_to_prior(summary, key), number(summary.get(f"{key}.{PRIOR}"))
        note = "" if ratio is None else f"{ratio:.1f} \N{MULTIPLICATION SIGN} the best constant's {constant}"
        add(f"Occupancy IoU, {title}, now", summary.get(key), 3, "", note)
    for metric, title, unit in (
        ("uniad.l2_avg_m", "Planning L2, UniAD, average", "m"),
        ("uniad.collision_avg_pct", "Planning collisions, UniAD, average", "%"),
    ):
        other = summary.get(f"planning.{REFERENCE}.{metric}")
        note = "" if other is None else f"{words(REFERENCE)}: {number(other, 2)} {unit}"
        add(title, summary.get(f"planning.{metric}"), 2, unit, note)
    psnr = next((value for key, value in summary.items() if key.endswith(".psnr_db")), None)
    add("Rendered images, PSNR", psnr, 1, "dB")
    add("Time of evaluation", summary.get("wall_s"), 0, "s")
    add("Peak memory", summary.get("peak_rss_gib"), 1, "GiB")
    return tiles
