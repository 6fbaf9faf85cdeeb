"""`foredrive compare`."""

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
) -> None:
    """Compare agents drive by drive: scores, progress and infractions with paired intervals.

    Intervals are of a bootstrap over routes, of differences of drives with the same route and repetition.
    The routes that separate the agents most are listed first.

    Args:
        runs: Folders of `foredrive drive`; the first is the one that the others are compared with. Folders
            joined by commas count as one agent, such as those of several training seeds.
        out: Folder for summary.json and report.html.
        shown: Number of routes to print.
    """
    check_out_folder(out)
    check_number("--shown", shown, low=0)
    with importing():
        from rich.console import Console

        from foredrive.engine.folder import SUMMARY, held_for_results
        from foredrive.engine.provenance import collect_provenance
        from foredrive.engine.summary import write_summary
        from foredrive.runs.drive.compare import compare as compare_agents
        from foredrive.runs.drive.compare import figures_of, read_agent
        from foredrive.view.compare_report import (
            REPORT,
            means_table,
            routes_table,
            write_compare_report,
        )
        from foredrive.view.table import print_table

    comparison = compare_agents([read_agent(given) for given in runs])
    with held_for_results(out):
        write_summary(out / SUMMARY, figures_of(comparison) | collect_provenance())
        write_compare_report(out / REPORT, comparison)
    console = Console()
    print_table(means_table(comparison), console)
    if shown:
        print_table(routes_table(comparison, shown), console)
    print(f"wrote {out / SUMMARY} and {out / REPORT}")
