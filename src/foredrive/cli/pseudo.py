"""`foredrive pseudo`."""

from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import check_number, check_out_folder, check_reconstruction
from foredrive.errors import InputError
from foredrive.lazy import importing
from foredrive.runs.drive.agents import absolute_name


def pseudo(
    reconstructed: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="RECONSTRUCTED [RECONSTRUCTED ...]", help_behavior_hint="(required)"),
    ],
    agent: Annotated[str, tyro.conf.arg(metavar="RUN|constant-velocity|stop|log|…")],
    out: Path,
    every: Annotated[float, tyro.conf.arg(metavar="S")] = 1.0,
) -> None:
    """Score plans in reconstructions by NAVSIM v2's EPDMS, with its two-stage pseudo-simulation.

    The agent plans from the logged state, and again from states beside the path 3 s later.
    docs/safety-tests.md describes the differences from NAVSIM's devkit.

    Args:
        reconstructed: Folders of reconstructions whose logs still exist and have maps.
        agent: As for `foredrive drive --in`.
        out: Folder for summary.json.
        every: Time between two starts in a log, s.
    """
    check_out_folder(out)
    check_number("--every", every, above=0)
    if not reconstructed:
        raise InputError("name at least one reconstruction (RECONSTRUCTED)")
    for folder in reconstructed:
        check_reconstruction(folder)
    with importing():
        from rich.console import Console

        from foredrive.runs.drive.pseudo import pseudo_simulate
        from foredrive.view.pseudo_table import pseudo_table
        from foredrive.view.table import print_table

    name = absolute_name(agent)
    summary = pseudo_simulate([str(folder.absolute()) for folder in reconstructed], name, out, every)
    print_table(pseudo_table(summary), Console())
    print(f"wrote {out / 'summary.json'}")
