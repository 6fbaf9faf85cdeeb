"""The report of an evaluated run."""

import datetime
from collections.abc import Sequence

from foredrive.data import LogPath
from foredrive.evaluation import Failure
from foredrive.runs import ExamplePrediction, Run
from foredrive.runs.train.run import STAGES
from foredrive.training import read_metrics
from foredrive.view.example_panel import ExamplePanel
from foredrive.view.loss_curves import Losses
from foredrive.view.origin import Provenance
from foredrive.view.report import ReportData
from foredrive.view.table import Summary

OCCUPIED_ABOVE = 0.5
FAILURES_NAMED = 5


def report_on_run(
    run: Run,
    logs: Sequence[LogPath],
    summary: Summary,
    inspections: Sequence[ExamplePrediction],
    failures: Sequence[Failure] = (),
) -> ReportData:
    """Collect the content of a run's report on some logs; the first few failures are named."""
    losses = {stage: read_metrics(run.folder / stage / "metrics.jsonl") for stage in STAGES}
    return ReportData(
        title=f"{run.recipe.name} on {_names(logs)}",
        origin=Provenance.of(summary, datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")),
        summary=summary,
        losses=losses,
        panels=[inspection_panel(inspection) for inspection in inspections],
        notes=_notes(run, logs, failures, losses),
    )


def inspection_panel(inspection: ExamplePrediction) -> ExamplePanel:
    """Return the panel of an example."""
    log, _, t_us = inspection.example.key[0].rpartition("@")
    taken = datetime.datetime.fromtimestamp(int(t_us) * 1e-6, datetime.UTC)
    return ExamplePanel(
        title=f"{log} at {taken:%Y-%m-%d %H:%M:%S}.{taken.microsecond // 10_000:02d} UTC",
        example=inspection.example,
        occupied=inspection.occupancy_prob > OCCUPIED_ABOVE,
        rendered=inspection.rendered,
        volume=inspection.volume,
        plan=inspection.plan,
    )


def _names(logs: Sequence[LogPath]) -> str:
    names = [log.name for log in logs]
    return ", ".join(names) if len(names) <= 3 else f"{names[0]} and {len(names) - 1} more logs"


def _notes(
    run: Run,
    logs: Sequence[LogPath],
    failures: Sequence[Failure],
    losses: Losses,
) -> list[str]:
    """Return the facts that a reader needs in order to interpret the metrics correctly."""
    notes = []
    seen = {log.folder for log in run.logs} & {log.folder for log in logs}
    if seen:
        notes.append(
            f"{len(seen)} of the {len(logs)} evaluated logs were trained on: these figures show that "
            "the model fits, not that it generalises."
        )
    rendered = [lines for lines in losses.values() if lines and "perc" in lines[0]]
    if any(not any(line["perc"] for line in lines) for lines in rendered):
        notes.append("The perceptual loss was off in training (no VGG-16 weights, or weight 0).")
    notes += [f"Failed: {failure.key}: {failure.reason}" for failure in failures[:FAILURES_NAMED]]
    return notes
