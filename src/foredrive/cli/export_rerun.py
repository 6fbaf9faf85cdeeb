"""`foredrive export rerun`."""

import importlib.util
import os
from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import OptionalPath, check_run
from foredrive.cli.progress import progress_lines
from foredrive.errors import InputError
from foredrive.lazy import importing


def export_rerun(
    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    out: Path,
    run: OptionalPath = None,
    reconstructed: Annotated[OptionalPath, tyro.conf.arg(name="in", metavar="RECONSTRUCTED")] = None,
) -> None:
    """Write a log as a file of Rerun, with a run's plans and a reconstruction's Gaussians if they are named.

    The file has images, sweeps, boxes, the map, poses and the driven path, and a blueprint; with a run also
    the plan and the predicted occupancy. Open it with `rerun FILE`. Rerun's cameras are pinholes: images are
    not undistorted.

    Args:
        log: A log, or a data root with one log.
        out: The file, which ends in .rrd.
        run: Folder of a trained run whose predictions are added.
        reconstructed: Folder of a reconstruction of this log whose Gaussians are added.
    """
    from foredrive.data.log_paths import find_one_log

    if importlib.util.find_spec("rerun") is None:
        raise InputError("Rerun's files need the package rerun-sdk: pip install 'foredrive[rerun]'")
    path = find_one_log(log)
    if run is not None:
        run = check_run(run)

    os.environ.setdefault("RUST_LOG", "off")  # Rerun's own lines about a full disk
    with importing():
        from foredrive.runs import open_run
        from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
        from foredrive.view.log_rerun import write_log_rerun

    rebuilt = None if reconstructed is None else open_reconstruction(reconstructed)
    with progress_lines(lambda: f"exporting {path.name}"):
        entities = write_log_rerun(path, out, None if run is None else open_run(run), rebuilt)
    print(f"wrote {out} with {', '.join(entities)}")
