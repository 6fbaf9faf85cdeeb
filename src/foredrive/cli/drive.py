"""`foredrive drive`."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from foredrive.cli.arguments import check_out_folder
from foredrive.cli.drive_options import InputFaults, InReconstruction, InTowns, Planning
from foredrive.cli.failures import listed_failures
from foredrive.errors import InputError
from foredrive.lazy import importing
from foredrive.runs.drive.agents import absolute_name, agents_help

if TYPE_CHECKING:
    from foredrive.driving.drive_record import DriveRecord
    from foredrive.runs.drive.suite import DriveJob, SuiteResult


def drive(
    agent: Annotated[str, tyro.conf.arg(metavar="RUN|embedded|expert|idm|…", help=agents_help())],
    out: Path,
    planning: tyro.conf.OmitArgPrefixes[Planning],
    inputs: tyro.conf.OmitArgPrefixes[InputFaults],
    towns: tyro.conf.OmitArgPrefixes[InTowns],
    reconstructed: tyro.conf.OmitArgPrefixes[InReconstruction],
) -> None:
    """Drive routes in closed loop and score them like CARLA's leaderboards 1.0 and 2.1.

    Every drive is saved when it ends, with a 123D log of the sensor data. A saved drive is not driven again.
    With --in the agent drives in a reconstructed log instead of towns, along the path of the log. With
    --carla it drives in the towns of a CARLA server.

    Args:
        agent: The agent that drives: a row of the table in `foredrive.runs.drive.agents`.
        out: Folder of the suite: summary.json, report.html, drives, logs.
    """
    check_out_folder(out)
    for options in (planning, inputs, towns, reconstructed):
        options.check()
    if reconstructed.reconstructed is not None:
        towns.check_unchanged(InTowns(), "--in")
    with importing():
        from foredrive.runs.drive.suite import DriveSuite, drive_suite

    # Workers may run in other folders, so the folder of a run is named by its absolute path
    name = absolute_name(agent)
    source = reconstructed.source() or towns.source(name)
    rig = getattr(source, "rig", None)
    faults = inputs.faults(() if rig is None else tuple(rig.cameras))
    suite = DriveSuite(
        name, source, planning.sensors, planning.lidar, planning.period, planning.latency, faults
    )
    workers = towns.workers or len(os.sched_getaffinity(0))
    with DrivesProgress(len(suite.jobs())) as progress:
        driven = drive_suite(
            suite,
            out,
            workers,
            on_ray=towns.ray,
            tick=progress.tick,
            report=lambda _: _write_report(out),
            tried=lambda text: print(f"{name} was {text}", flush=True),
        )
    check_driven(driven)
    _tell(driven)
    print(f"report: {out / 'report.html'}")


def _write_report(out: Path) -> None:
    from foredrive.view.drive_report import write_drive_report  # Imports Matplotlib

    write_drive_report(out)


def check_driven(driven: "SuiteResult") -> None:
    """Check that no drive failed, and print how many had been driven before.

    Raises:
        InputError: some drives failed.
    """
    if driven.broken:
        failures = listed_failures({job.name: reason for job, reason in driven.broken.items()})
        whole = len(driven.drives) + len(driven.broken)
        raise InputError(
            f"{len(driven.broken)} of {whole} drives failed: {failures}; "
            "the other drives are kept, and scores need all drives"
        )
    if driven.skipped:
        print(f"{driven.skipped} of {len(driven.drives)} drives had been driven before")


def _tell(driven: "SuiteResult") -> None:
    """Print the scores."""
    from rich.console import Console

    from foredrive.runs.drive.records import summarise
    from foredrive.view.drive_report import score_table, threat_text
    from foredrive.view.table import print_table

    print_table(score_table(summarise(list(driven.drives.values()))), Console())
    for met in (drive.threat for drive in driven.drives.values() if drive.threat):
        print(f"{met.kind} threat: {threat_text(met)}")


class DrivesProgress:
    """A progress bar over all drives, with the mean driving score so far."""

    def __init__(self, total: int) -> None:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        self._progress = Progress("driving", *columns, TextColumn("{task.fields[score]}"))
        self._bar = self._progress.add_task("", total=total, score="")
        self._scores: list[float] = []

    def __enter__(self) -> "DrivesProgress":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def tick(self, job: "DriveJob", drive: "DriveRecord | None") -> None:
        """Count one more finished drive."""
        if drive is not None:
            self._scores.append(drive.driving_score_1_0)
        mean = f"score {sum(self._scores) / len(self._scores):.1f}" if self._scores else ""
        self._progress.update(self._bar, advance=1, score=mean)
