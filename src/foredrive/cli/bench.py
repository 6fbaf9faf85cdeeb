"""`foredrive bench`."""

import importlib.util
import os
import sys
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from foredrive.errors import InputError
from foredrive.lazy import importing

if TYPE_CHECKING:
    from foredrive.engine.bench import Benchmark


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
    with importing():
        from foredrive.engine.bench import run_benchmark

    files = {path.stem.replace("_", "-"): path for path in sorted(folder.glob("*.py"))}
    if not files:
        raise InputError(
            f"{folder}: no benchmarks here; run this in a checkout of Foredrive, or set --folder"
        )
    if queue:
        if name is not None or arms or seeds:
            raise InputError("--queue measures what queue.yaml names; leave out NAME, --arms and --seeds")
        _run_queue(files, folder, workers, dry_run)
        return
    if workers or dry_run:
        raise InputError("--workers and --dry-run belong to --queue")
    if name is None:
        for benchmark_name, path in files.items():
            benchmark = _load(path)
            if benchmark is None:
                print(f"{benchmark_name}: a separate script; run it with python {path}")
            else:
                print(f"{benchmark_name}: {benchmark.question}\n    arms: {', '.join(benchmark.arms)}")
        return
    name = name.replace("_", "-")
    if name not in files:
        raise InputError(f"no benchmark {name!r} in {folder}; there are: {', '.join(files)}")
    chosen = _load(files[name])
    if chosen is None:
        raise InputError(f"{files[name]}: defines no BENCHMARK")
    path = run_benchmark(name, chosen, folder / "results", arms=arms or None, seeds=seeds or None)
    print(f"wrote {path}")


def _run_queue(files: Mapping[str, Path], folder: Path, workers: int, dry_run: bool) -> None:
    """Measure what the queue lacks, or list it."""
    from foredrive.engine.study_queue import Measurement, load_queue, missing_measurements, run_queue

    benchmarks = {name: chosen for name, path in files.items() if (chosen := _load(path)) is not None}
    studies = load_queue(folder / "queue.yaml", benchmarks)

    def missing() -> list[Measurement]:
        return missing_measurements(studies, benchmarks, folder / "results")

    todo, cores = missing(), sorted(os.sched_getaffinity(0))[: workers or None]
    minutes = sum(one.cpu_minutes for one in todo)
    if dry_run:
        for claim, measurements in groupby(todo, key=lambda one: one.claim):
            left = list(measurements)
            print(f"{claim}: {len(left)} measurements, {sum(one.cpu_minutes for one in left):.0f} minutes")
            for one in left:
                print(f"    {one.name}")
    print(
        f"{len(todo)} measurements are missing, about {minutes / 60:.1f} hours of computing, "
        f"{minutes / 60 / len(cores):.1f} on {len(cores)} cores"
    )
    if dry_run:
        return

    def command(one: Measurement) -> list[str]:
        chosen = ["--arms", one.arm, "--seeds", str(one.seed), "--folder", str(folder)]
        return ["-m", "foredrive", "bench", one.bench, *chosen]

    if failed := run_queue(missing, command, cores):
        raise InputError(f"{len(failed)} measurements failed: {', '.join(failed)}")


def _load(path: Path) -> "Benchmark | None":
    """Load the BENCHMARK of a file; return None if the file defines none."""
    from foredrive.engine.bench import Benchmark

    module_name = f"benchmarks.{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Registered before it runs: its dataclasses look up their module there
    sys.modules[module_name] = module
    sys.path.insert(0, str(path.absolute().parent.parent))  # For `benchmarks.common`
    spec.loader.exec_module(module)
    benchmark = getattr(module, "BENCHMARK", None)
    return benchmark if isinstance(benchmark, Benchmark) else None
