"""The programs of a folder of benchmarks, as `foredrive bench` lists and runs them."""

import importlib.util
import os
import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from benchmarks.common.benchmark import Benchmark, run_benchmark
from benchmarks.common.study_queue import Measurement, load_queue, missing_measurements, run_queue
from foredrive.errors import InputError


def list_programs(folder: Path) -> None:
    """Print each benchmark with its question and its arms."""
    for name, path in _files(folder).items():
        benchmark = _load(path)
        if benchmark is None:
            print(f"{name}: a separate script; run it with python {path}")
        else:
            print(f"{name}: {benchmark.question}\n    arms: {', '.join(benchmark.arms)}")


def run_program(folder: Path, name: str, arms: Sequence[str], seeds: Sequence[int]) -> None:
    """Run a benchmark; without arms or seeds all of them.

    Raises:
        InputError: there is no such benchmark, arm or seed.
    """
    name, files = name.replace("_", "-"), _files(folder)
    if name not in files:
        raise InputError(f"no benchmark {name!r} in {folder}; there are: {', '.join(files)}")
    chosen = _load(files[name])
    if chosen is None:
        raise InputError(f"{files[name]}: defines no BENCHMARK")
    path = run_benchmark(name, chosen, folder / "results", arms=arms or None, seeds=seeds or None)
    print(f"wrote {path}")


def run_queued(folder: Path, workers: int, dry_run: bool) -> None:
    """Measure what the queue of a folder lacks, or list it.

    Raises:
        InputError: the queue cannot be read, or a measurement failed twice.
    """
    benchmarks = {
        name: chosen for name, path in _files(folder).items() if (chosen := _load(path)) is not None
    }
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


def _files(folder: Path) -> dict[str, Path]:
    """Return the files of a folder's benchmarks by the names of the benchmarks."""
    return {path.stem.replace("_", "-"): path for path in sorted(folder.glob("*.py"))}


def _load(path: Path) -> Benchmark | None:
    """Load the BENCHMARK of a file; return None if the file defines none."""
    module_name = f"benchmarks.{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Registered before it runs: its dataclasses look up their module there
    sys.modules[module_name] = module
    spec.loader.exec_module(module)
    benchmark = getattr(module, "BENCHMARK", None)
    return benchmark if isinstance(benchmark, Benchmark) else None
