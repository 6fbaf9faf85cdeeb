"""`foredrive bench`: the benchmarks of a checkout, whose machinery stands beside them."""

import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated

import tyro

from foredrive.errors import InputError
from foredrive.lazy import importing


def bench(
    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = None,
    arms: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ARM [ARM ...]")] = (),
    seeds: Annotated[tuple[int, ...], tyro.conf.arg(metavar="SEED [SEED ...]")] = (),
    queue: bool = False,
    workers: int = 0,
    dry_run: bool = False,
    folder: Path = Path("benchmarks"),
) -> None:
    """List the benchmarks, or run one and write FOLDER/results/NAME.json.

    Args:
        name: Benchmark to run. An interrupted benchmark continues where it stopped. Without a name, all
            benchmarks are listed.
        arms: Run only these arms.
        seeds: Run only these seeds.
        queue: Measure what the studies in FOLDER/queue.yaml lack, what decides most for its computing time
            first, one process on each core. It continues where it was interrupted.
        workers: Number of cores that the queue takes; 0: all.
        dry_run: Only list what the queue would measure.
        folder: Folder of the benchmarks. Each benchmark is a Python file that defines BENCHMARK; its file
            name has _ in place of -.
    """
    absent = InputError(f"{folder}: no benchmarks here; run this in a checkout of Foredrive, or set --folder")
    if not next(folder.glob("*.py"), None):
        raise absent
    sys.path.insert(0, str(folder.absolute().parent))  # For `benchmarks.common`
    try:
        with importing():
            programs = import_module("benchmarks.common.programs")
    except ModuleNotFoundError as error:
        if error.name is None or not error.name.startswith("benchmarks"):
            raise
        raise absent from error
    if queue:
        if name is not None or arms or seeds:
            raise InputError("--queue measures what queue.yaml names; leave out NAME, --arms and --seeds")
        programs.run_queued(folder, workers, dry_run)
    elif workers or dry_run:
        raise InputError("--workers and --dry-run belong to --queue")
    elif name is None:
        programs.list_programs(folder)
    else:
        programs.run_program(folder, name, arms, seeds)
