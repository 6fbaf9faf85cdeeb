"""`foredrive bench`."""

import importlib.util
import sys
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
    folder: Path = Path("benchmarks"),
) -> None:
    """List the benchmarks, or run one and write FOLDER/results/NAME.json.

    Args:
        name: Benchmark to run. An interrupted benchmark continues where it stopped. Without a name, all
            benchmarks are listed.
        arms: Run only these arms.
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
    print(f"wrote {run_benchmark(name, chosen, folder / 'results', arms=arms or None)}")


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
