"""One self-contained page about a run: figures, tables, curves and example panels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from foredrive.files import atomic_path
from foredrive.view.example_panel import ExamplePanel, panel_html
from foredrive.view.loss_curves import draw_loss_curves
from foredrive.view.report_style import CSS
from foredrive.view.summary_tables import (
    Figure,
    Summary,
    flow_table,
    full_table,
    image_table,
    number,
    occupancy_table,
    planning_tables,
    ratio_to_constant,
)

COMMAND_SOURCES = {
    "route": "the log's route",
    "driven_future": "the driven future, which leaks part of the answer",
    "none": "nowhere",
}
AGAINST = "constant_velocity"


@dataclass(frozen=True)
class ReportData:
    """What a report shows; a part without content is left out."""

    title: str
    command: str
    """The command that made the run."""
    commit: str
    machine: str
    date: str
    summary: Summary
    """summary.json: flat dotted keys."""
    losses: Mapping[str, Sequence[Mapping[str, float | int]]]
    """Per stage the lines of its metrics file."""
    panels: Sequence[ExamplePanel]
    notes: Sequence[str] = ()
    """What a reader must know to read the figures rightly."""


def write_report(path: Path, report: ReportData) -> None:
    """Write the page: one HTML file with its pictures inside, which loads nothing from anywhere."""
    page = report_html(report)
    with atomic_path(path) as scratch:
        scratch.write_text(page, encoding="utf-8")


def report_html(report: ReportData) -> str:
    """The page as text."""
    summary = report.summary
    parts = [
        f"<h1>{escape(report.title)}</h1>",
        _run(report),
        _alerts(report),
        _section("In short", _tiles(summary)),
        _section("Planning, open loop", planning_tables(summary)),
        _section("Occupancy on voxels the lidar knows", occupancy_table(summary)),
        _section("Flow on voxels that move", flow_table(summary)),
        _section("Rendered images", image_table(summary)),
        _section("Losses", draw_loss_curves(report.losses)),
        _section("Examples", "\n".join(panel_html(panel) for panel in report.panels)),
        f"<details><summary>Every figure</summary>{full_table(summary)}</details>",
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(report.title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body>\n</html>\n"
    )


def _section(title: str, content: str) -> str:
    return f"<section><h2>{title}</h2>\n{content}\n</section>" if content else ""


def _run(report: ReportData) -> str:
    rows = {
        "command": f"<code>{escape(report.command)}</code>",
        "commit": f"<code>{escape(report.commit)}</code>",
        "machine": escape(report.machine),
        "date": escape(report.date),
    }
    return '<dl class="run">' + "".join(f"<dt>{k}</dt><dd>{v}</dd>" for k, v in rows.items()) + "</dl>"


def _alerts(report: ReportData) -> str:
    """What failed, where commands came from, and what else must not be overlooked."""
    summary = report.summary
    lines = []
    for key, count in summary.items():
        if key == "failed" or (key.endswith(".failed") and count):
            who = "this model" if key == "failed" else key.split(".")[-2].replace("_", " ")
            text = f"Failed items of {who}: {number(count)}."
            lines.append(f"<strong>{text}</strong>" if count else text)
    for source, title in COMMAND_SOURCES.items():
        count = summary.get(f"command_source.{source}")
        if count:
            text = f"Commands taken from {title}: {number(count)}."
            lines.append(f"<strong>{text}</strong>" if source == "driven_future" else text)
    lines += [escape(note) for note in report.notes]
    return f'<div class="alert">{"<br>".join(lines)}</div>' if lines else ""


def _tiles(summary: Summary) -> str:
    """The few figures a reader looks for first."""
    tiles = []
    for scope, title in (
        ("above_ground.", "Occupancy IoU above ground, now"),
        ("", "Occupancy IoU, all, now"),
    ):
        key = f"occupancy.{scope}iou_now"
        ratio = ratio_to_constant(summary, key)
        note = (
            ""
            if ratio is None
            else (f"{ratio:.1f} &times; the best constant's {number(summary[f'{key}.best_constant'])}")
        )
        tiles.append(_tile(title, summary.get(key), 3, "", note))
    for metric, title, unit in (
        ("uniad.l2_avg_m", "Planning L2, UniAD, average", "m"),
        ("uniad.collision_avg_pct", "Planning collisions, UniAD, average", "%"),
    ):
        other = summary.get(f"planning.{AGAINST}.{metric}")
        note = "" if other is None else f"constant velocity: {number(other, 2)} {unit}"
        tiles.append(_tile(title, summary.get(f"planning.{metric}"), 2, unit, note))
    psnr = next((value for key, value in summary.items() if key.endswith(".psnr_db")), None)
    tiles.append(_tile("Rendered images, PSNR", psnr, 1, "dB", ""))
    tiles.append(_tile("Time of evaluation", summary.get("wall_s"), 0, "s", ""))
    tiles.append(_tile("Peak memory", summary.get("peak_rss_gib"), 1, "GiB", ""))
    shown = "".join(tiles)
    return f'<div class="tiles">{shown}</div>' if shown else ""


def _tile(name: str, value: Figure, digits: int, unit: str, note: str) -> str:
    if value is None:
        return ""
    below = f'<div class="name">{note}</div>' if note else ""
    return (
        f'<div class="tile"><div class="name">{name}</div>'
        f'<div class="value">{number(value, digits)} <small>{unit}</small></div>{below}</div>'
    )
