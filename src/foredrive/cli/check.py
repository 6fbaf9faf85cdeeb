"""`foredrive check`."""

from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.failures import listed_failures
from foredrive.cli.progress import job_progress
from foredrive.errors import InputError
from foredrive.lazy import importing


def check(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    json: bool = False,
) -> None:
    """Check 123D logs: what is in them, and what looks wrong.

    It looks for gaps in time, poses that jump, speeds that do not fit them, clocks that are off, black or
    frozen images, empty sweeps, an ego frame that is not on the ground, boxes without points, and
    calibrations with which lidar points do not fit the images. Problems are printed. The exit code is 0
    unless a log cannot be opened; the other logs are checked all the same.

    Args:
        logs: Logs, folders of logs, or lists of clips.
        json: Print JSON: one object for each log.
    """
    with importing():
        import dataclasses
        from json import dumps

        from rich.console import Console

        from foredrive.data import find_all_logs
        from foredrive.data.log_check import Finding, LogCheck
        from foredrive.runs.check import check_with_calibration
        from foredrive.view.check_table import check_table
        from foredrive.view.table import print_table

    checks, unopened = [], {}
    paths = find_all_logs(logs)
    with job_progress("checking logs", len(paths)) as tick:
        for path in paths:
            try:
                checks.append(check_with_calibration(path))
            except InputError as error:
                unopened[path.name] = str(error)
                checks.append(LogCheck(path.name, 0, 0.0, 0.0, [], [Finding("problem", "log", str(error))]))
            if not json:
                print_table(check_table(checks[-1]), Console())
            tick()
    if json:
        print(dumps([dataclasses.asdict(check) for check in checks], indent=2))
    if unopened and len(checks) == 1:
        raise InputError(next(iter(unopened.values())))
    if unopened:
        raise InputError(f"{len(unopened)} of {len(checks)} logs: {listed_failures(unopened)}")
