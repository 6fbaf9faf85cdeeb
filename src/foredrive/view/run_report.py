"""The report of an evaluated run: metrics, tables, loss curves and examples on one self-contained page."""

import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from foredrive.data import LogPath
from foredrive.engine.metrics_log import read_metrics
from foredrive.engine.summary import Summary
from foredrive.runs import ExamplePrediction, Run
from foredrive.runs.train.run import STAGES
from foredrive.tasks.evaluation.run import Failure
from foredrive.view.example_panel import draw_example
from foredrive.view.html import INK_MARK, MetricTile, Provenance, inline_svg, style_axes, write_page
from foredrive.view.summary_tables import (
    AGENT_TITLES,
    clips_text,
    flow_table,
    full_table,
    image_table,
    occupancy_table,
    planning_overview,
    planning_table,
    prior_comparison,
    task_table,
    vehicle_table,
)
from foredrive.view.table import Value, number, words

COLOURS = ("#3f8efc", "#f2803c", "#2eb67d", "#d1559b", "#a78bfa", "#c9a227", "#e5484d")
NOT_LOSSES = ("step", "step_s", "cpu_s", "lr")
SMOOTH_STEPS = 15
LEGEND_COLUMNS = 5
Losses = Mapping[str, Sequence[Mapping[str, float | int]]]
"""For each stage the lines of its metrics file: "step" and a value for each loss."""


def draw_loss_curves(stages: Losses) -> Markup | None:
    """Draw a chart for each stage: values faint, their running mean strong, on a logarithmic scale.

    Returns:
        SVG, or None if no stage has any lines.
    """
    shown = {name: lines for name, lines in stages.items() if lines}
    if not shown:
        return None
    figure = Figure(figsize=(5.2 * len(shown), 3.1), layout="constrained")
    axes = figure.subplots(1, len(shown), squeeze=False)[0]
    for ax, (name, lines) in zip(axes, shown.items(), strict=True):
        _draw_stage(ax, name, lines)
    return inline_svg(figure)


def _draw_stage(ax: Axes, name: str, lines: Sequence[Mapping[str, float | int]]) -> None:
    names = [key for key in lines[0] if key not in NOT_LOSSES]
    names.sort(key=lambda key: key != "loss")  # The minimised loss comes first
    for key, colour in zip(names, COLOURS, strict=False):
        steps = np.array([line["step"] for line in lines if key in line], dtype=float)
        values = np.array([line[key] for line in lines if key in line], dtype=float)
        if not (values > 0).any():
            continue
        positive = np.where(values > 0, values, np.nan)
        ax.plot(steps, positive, color=colour, linewidth=0.8, alpha=0.3)
        ax.plot(steps, _running_mean(positive), color=colour, linewidth=1.9, label=key)
    ax.set_yscale("log")
    style_axes(ax, name, "step")
    if ax.lines:
        legend_rows = math.ceil(len(names) / LEGEND_COLUMNS)
        ax.legend(
            frameon=False,
            labelcolor=INK_MARK,
            fontsize=9,
            loc="lower right",
            bbox_to_anchor=(1.0, 0.98),
            ncols=math.ceil(len(names) / legend_rows),
            handlelength=1.2,
            columnspacing=1.2,
        )


def _running_mean(values: Float[np.ndarray, " S"]) -> Float[np.ndarray, " S"]:
    """Return the mean of the last few finite values at each step."""
    number = np.isfinite(values)
    total = np.cumsum(np.where(number, values, 0.0))
    count = np.cumsum(number)
    # The difference of two cumulative sums is the sum over the last few steps
    total[SMOOTH_STEPS:] -= total[:-SMOOTH_STEPS].copy()
    count[SMOOTH_STEPS:] -= count[:-SMOOTH_STEPS].copy()
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


COMMAND_SOURCES = {
    "route": "Commands from the log's route",
    "driven_future": "Commands from the driven future, which leaks part of the answer",
    "none": "Unknown commands",
}
REFERENCES = ("ego_mlp", "constant_velocity")
"""Baselines of planning. The tiles compare the model with the first one that was evaluated."""
MAX_NAMED_FAILURES = 5


@dataclass(frozen=True)
class RunReport:
    """The content of a report. Parts without content are left out."""

    title: str
    provenance: Provenance
    summary: Summary
    losses: Losses
    examples: Sequence[ExamplePrediction]
    notes: Sequence[str] = ()
    """Facts that a reader needs in order to interpret the metrics correctly."""


@dataclass(frozen=True)
class Alert:
    """A line above the metrics; a warning stands out."""

    text: str
    is_warning: bool = False


def report_on_run(
    run: Run,
    logs: Sequence[LogPath],
    summary: Summary,
    examples: Sequence[ExamplePrediction],
    failures: Sequence[Failure] = (),
) -> RunReport:
    """Collect the content of a run's report on some logs; the first few failures are named."""
    losses = {stage: read_metrics(run.folder / stage / "metrics.jsonl") for stage in STAGES}
    names = [log.name for log in logs]
    named = ", ".join(names) if len(names) <= 3 else f"{names[0]} and {len(names) - 1} more logs"
    return RunReport(
        title=f"{run.recipe.name} on {named}",
        provenance=Provenance.of(summary, datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")),
        summary=summary,
        losses=losses,
        examples=examples,
        notes=_notes(run, logs, failures, losses),
    )


def write_run_report(path: Path, report: RunReport) -> None:
    """Write the page."""
    summary = report.summary
    tables = (
        occupancy_table(summary),
        vehicle_table(summary),
        flow_table(summary),
        image_table(summary),
        task_table(summary),
    )
    write_page(
        path,
        "run_report.html.j2",
        title=report.title,
        provenance=report.provenance,
        alerts=_alerts(report),
        tiles=_tiles(summary),
        planning_overview=planning_overview(summary),
        planning=planning_table(summary),
        tables=[table for table in tables if table is not None],
        curves=draw_loss_curves(report.losses),
        panels=[draw_example(example) for example in report.examples],
        all_metrics=full_table(summary),
    )


def _notes(run: Run, logs: Sequence[LogPath], failures: Sequence[Failure], losses: Losses) -> list[str]:
    notes = []
    trained_on = {log.folder for log in run.logs} & {log.folder for log in logs}
    if trained_on:
        notes.append(
            f"{len(trained_on)} of the {len(logs)} evaluated logs were trained on: these figures show that "
            "the model fits, not that it generalises."
        )
    # Stages that render have the perceptual loss "perc", which is 0 in all steps if it is off
    rendered = [lines for lines in losses.values() if lines and "perc" in lines[0]]
    if any(not any(line["perc"] for line in lines) for lines in rendered):
        notes.append("The perceptual loss was off in training (no VGG-16 weights, or weight 0).")
    return notes + [f"Failed: {failure.key}: {failure.reason}" for failure in failures[:MAX_NAMED_FAILURES]]


def _alerts(report: RunReport) -> list[Alert]:
    """Return lines about judged and failed clips, the sources of the commands, and the notes."""
    judged = clips_text(report.summary)
    alerts = [] if judged is None else [Alert(f"Judged: {judged}.")]
    for key, count in report.summary.items():
        if key == "failed" or (key.endswith(".failed") and count):
            method = "this model" if key == "failed" else words(key.split(".")[-2])
            alerts.append(Alert(f"Failed clips of {method}: {number(count)}.", bool(count)))
    for source, title in COMMAND_SOURCES.items():
        if count := report.summary.get(f"command_source.{source}"):
            alerts.append(Alert(f"{title}: {number(count)}.", source == "driven_future"))
    return alerts + [Alert(note) for note in report.notes]


def _tiles(summary: Summary) -> list[MetricTile]:
    """Return tiles of the main metrics."""
    tiles = []

    def add(name: str, value: Value, digits: int, unit: str = "", note: str = "") -> None:
        if value is not None:
            tiles.append(MetricTile(name, number(value, digits), unit, note))

    for scope, title in (("above_ground.", "above ground"), ("", "all voxels")):
        key = f"occupancy.{scope}iou_now"
        add(f"Occupancy IoU now, {title}", summary.get(key), 3, "", prior_comparison(summary, key))
    for metric, title, unit in (
        ("uniad.l2_avg_m", "Planning L2, UniAD, average", "m"),
        ("uniad.collision_avg_pct", "Planning collisions, UniAD, average", "%"),
    ):
        others = {name: summary.get(f"planning.{name}.{metric}") for name in REFERENCES}
        baselines = [f"{AGENT_TITLES.get(name, words(name))}: {number(value, 2)} {unit}"
                 for name, value in others.items() if value is not None]  # fmt: skip
        note = baselines[0] if baselines else ""
        add(title, summary.get(f"planning.{metric}"), 2, unit, note)
    add("Cars found, AP at 2 m within 30 m", summary.get("detection.car_ap_2m_30m"), 3)
    add("Semantic voxels, RayIoU", summary.get("occupancy.occ3d.rayiou_pct"), 1, "%")
    psnr = next((value for key, value in summary.items() if key.endswith(".psnr_db")), None)
    add("Rendered images, PSNR", psnr, 1, "dB")
    add("Evaluation time", summary.get("wall_s"), 0, "s")
    add("Peak memory", summary.get("peak_rss_gib"), 1, "GiB")
    return tiles
