"""`foredrive convert`."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import check_number, check_out_folder
from foredrive.cli.failures import listed_failures
from foredrive.errors import InputError
from foredrive.lazy import importing


def convert(
    dataset: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")],
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: Path,
    workers: int = 0,
    overwrite: bool = False,
) -> None:
    """Convert a raw data set into 123D logs.

    Logs that are there are kept, so a conversion that was stopped goes on where it was. A log that cannot be
    read does not stop the others.

    Args:
        dataset: pandaset, av2, nuscenes, nuscenes-sweeps (10 Hz), nuplan, waymo, waymo-motion, kitti360,
            kitti-raw, kitti-object, nuscenes-keyframe, griffin, truckdrive, physical-ai-av, ncore or
            nureasoning. Some need more packages; the message says which.
        source: Folder of one raw log, or of many.
        out: 123D data root to write to.
        workers: Number of logs converted at a time; 0: one for each core.
        overwrite: Convert logs again that are there.
    """
    check_number("--workers", workers, low=0)
    check_out_folder(out)
    if not source.is_dir():
        raise InputError(f"{source}: no such folder")

    with importing():
        from foredrive.runs.convert import convert_all

    failed, count = {}, 0
    with _progress(dataset) as tick:
        cores = workers or len(os.sched_getaffinity(0))
        for done in convert_all(source, dataset, out, cores, overwrite=overwrite, tick=tick):
            count += 1
            if done.log is None:
                failed[done.name] = done.failure or ""
            else:
                kept = " (was there; --overwrite converts it again)" if done.kept else ""
                print(f"{'kept' if done.kept else 'wrote'} {done.log.folder}{kept}", flush=True)
    if failed and count == 1:
        raise InputError(next(iter(failed.values())))
    if failed:
        raise InputError(f"{len(failed)} of {count} logs failed: {listed_failures(failed)}")


@contextmanager
def _progress(dataset: str) -> Iterator[Callable[[], None]]:
    """Show the number of frames and the time; yield the function that counts a frame."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task(f"converting {dataset}", total=None)
        frames = 0

        def tick() -> None:
            nonlocal frames
            frames += 1
            progress.update(bar, description=f"converting {dataset}: {frames} frames")

        yield tick
