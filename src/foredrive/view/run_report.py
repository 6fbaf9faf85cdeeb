"""The report of an evaluated run: metrics, tables, loss curves and examples on one self-contained page."""

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.data import LogPath
from foredrive.engine.metrics_log import read_metrics
from foredrive.engine.summary import Summary
from foredrive.runs import ExamplePrediction, Run
from foredrive.runs.train.run import STAGES
from foredrive.tasks.evaluation.run import Failure
from foredrive.view.example_panel import draw_example
from foredrive.view.html import MetricTile, Provenance, write_page
from foredrive.view.loss_curves import Losses, draw_loss_curves
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
