"""`foredrive compare`."""

import os
from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import check_number, check_out_folder
from foredrive.lazy import importing


def compare(
    runs: Annotated[
        tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[NAME=]FOLDER[,FOLDER ...]")
    ],
    out: Path = Path("runs/compare"),
    shown: int = 8,
    baselines: bool = False,
) -> None:
    """Rank agents, and compare them drive by drive: scores, progress and infractions with paired intervals.

    The ranking is by an item-response model of all drives; those that failed count for nothing. Intervals are
    over routes, and over trainings where an agent has several folders; the report says which. Those of
    differences are for drives with the same route and repetition. The routes that separate the agents most
    are listed first.

    Args:
        runs: Folders of `foredrive drive`; the first is the one that the others are compared with. Without
            NAME= an agent is called by the part of its path that tells it from the others. Folders
            joined by commas count as one agent, such as those of several training seeds.
        out: Folder for summary.json and report.html.
        shown: Number of routes to print.
        baselines: Drive the same routes with the agents stop, constant-velocity and go-straight, into
            OUT/baselines, and compare these too. What was driven is kept.
    """
    check_out_folder(out)
    check_number("--shown", shown, low=0)
    with importing():
        from rich.console import Console

        from foredrive.engine.folder import SUMMARY, held_for_results
        from foredrive.engine.provenance import collect_provenance
        from foredrive.engine.summary import write_summary
        from foredrive.runs.drive.compare import compare as compare_agents
        from foredrive.runs.drive.compare import figures_of, read_agents
        from foredrive.view.compare_report import (
            REPORT,
            means_table,
            ranking_table,
            routes_table,
            write_compare_report,
        )
        from foredrive.view.table import print_table

    agents = read_agents(runs)
    if baselines:
        agents += read_agents(_drive_baselines(agents[0].folders[0], out))
    comparison = compare_agents(agents)
    with held_for_results(out):
        write_summary(out / SUMMARY, figures_of(comparison) | collect_provenance())
        write_compare_report(out / REPORT, comparison)
    console = Console()
    print_table(ranking_table(comparison), console)
    print_table(means_table(comparison), console)
    if shown:
        print_table(routes_table(comparison, shown), console)
    print(f"wrote {out / SUMMARY} and {out / REPORT}")


def _drive_baselines(folder: Path, out: Path) -> list[str]:
    """Drive the baselines over the drives of a folder, and return them as `compare` takes agents."""
    from foredrive.cli.drive import DrivesProgress, check_driven
    from foredrive.runs.drive.agents import BASELINES
    from foredrive.runs.drive.baselines import same_drives
    from foredrive.runs.drive.suite import drive_suite

    driven = []
    for agent in BASELINES:
        suite, own = same_drives(folder, agent), out / "baselines" / agent
        with DrivesProgress(len(suite.jobs())) as progress:
            check_driven(drive_suite(suite, own, len(os.sched_getaffinity(0)), tick=progress.tick))
        driven.append(f"{agent}={own}")
    return driven
