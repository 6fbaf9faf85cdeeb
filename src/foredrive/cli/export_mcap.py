"""`foredrive export mcap`."""

import importlib.util
from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import OptionalPath, check_run
from foredrive.cli.progress import progress_lines
from foredrive.errors import InputError
from foredrive.lazy import importing


def export_mcap(
    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    out: Path,
    run: OptionalPath = None,
) -> None:
    """Write a log as an MCAP file of Foxglove's schemas, with a run's plans if one is named.

    The file has images, calibrations, sweeps, boxes, the map, poses and the driven path; with a run also the
    plan and the predicted occupancy. The schemas are Foxglove's; for Rerun see `export rerun`.

    Args:
        log: A log, or a data root with one log.
        out: The file, which ends in .mcap.
        run: Folder of a trained run whose predictions are added.
    """
    from foredrive.data.log_paths import find_one_log

    for package in ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf"):
        if importlib.util.find_spec(package) is None:
            raise InputError(f"MCAP files need the package {package}: pip install 'foredrive[bags]'")
    path = find_one_log(log)
    if run is not None:
        run = check_run(run)

    with importing():
        from foredrive.runs import open_run
        from foredrive.view.log_mcap import write_log_mcap

    with progress_lines(lambda: f"exporting {path.name}"):
        topics = write_log_mcap(path, out, None if run is None else open_run(run))
    print(f"wrote {out} with {', '.join(topics)}")
