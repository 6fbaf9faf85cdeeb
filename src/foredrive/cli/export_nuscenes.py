"""`foredrive export nuscenes`."""

import os
from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import check_number, check_out_folder, whole_logs
from foredrive.cli.failures import listed_failures
from foredrive.cli.progress import frame_progress
from foredrive.errors import InputError
from foredrive.lazy import importing


def export_nuscenes(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")],
    out: Path,
    name: str = "foredrive",
    rate: float = 2.0,
    sweeps: bool = True,
    workers: int = 0,
    overwrite: bool = False,
) -> None:
    """Write logs as a data set in nuScenes' format v1.0, which nuscenes-devkit opens.

    OUT gets v1.0-NAME with all tables, samples, sweeps and maps. Exported logs are kept, so an interrupted
    export continues where it stopped, and more logs can be added. A log that cannot be read does not stop the
    others.

    Args:
        logs: Logs, splits or data roots.
        out: Root of the data set: the devkit's dataroot.
        name: The tables are in v1.0-NAME: the devkit's version.
        rate: Samples (key frames) a second. The frames between them are sweeps.
        sweeps: Write the frames between the samples too.
        workers: Number of logs exported at a time; 0: one for each core.
        overwrite: Export logs again that were exported before.
    """
    check_number("--rate", rate, above=0)
    check_number("--workers", workers, low=0)
    check_out_folder(out)
    log_paths = whole_logs("export nuscenes", logs)

    with importing():
        from foredrive.integrations.nuscenes.dataset import NuScenesFolder
        from foredrive.integrations.nuscenes.scene import SceneOptions
        from foredrive.runs.nuscenes import export_nuscenes

    folder, failed = NuScenesFolder(out, name, SceneOptions(rate, sweeps)), {}
    with frame_progress("exporting") as tick:
        cores = workers or len(os.sched_getaffinity(0))
        for done in export_nuscenes(log_paths, folder, cores, overwrite=overwrite, tick=tick):
            if done.failure is not None:
                failed[done.name] = done.failure
            elif done.kept:
                print(f"kept {done.name} (was there; --overwrite exports it again)", flush=True)
            else:
                print(f"exported {done.name}", flush=True)
    print(f"wrote {folder.tables}")
    if failed:
        raise InputError(f"{len(failed)} of {len(log_paths)} logs failed: {listed_failures(failed)}")
