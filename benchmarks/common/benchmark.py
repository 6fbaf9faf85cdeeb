"""Benchmarks: arms side by side, over seeds, stored after each measurement.

A benchmark runs seed by seed and arm by arm. An interrupted run continues where it stopped. Figures of speed
are kept only while the code (commit and changes since), the benchmark's configuration and the machine are the
same. Figures of quality, such as those of trained models, are kept as long as the configuration and the
modules that decide them are the same. So a study may continue at another commit and on another machine.
"""

import ast
import hashlib
import importlib.util
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import mean, stdev
from typing import Any, TypeGuard

from filelock import FileLock

from foredrive.engine.provenance import collect_provenance
from foredrive.engine.summary import write_json
from foredrive.errors import InputError

MADE_ON = ("commit", "machine.cpu", "machine.cores")
"""Entries of the provenance that every run keeps for itself."""


@dataclass(frozen=True)
class Benchmark:
    """Arms to compare, all measured by this program on this machine."""

    question: str
    """The question that the figures answer, in one line."""
    arms: Mapping[str, Callable[[int], Mapping[str, float]]]
    """Functions by name: seed → figures by name, units in the names. ARM@PART is a part of ARM. It is
    measured and stored separately, and its figures are reported as figures of ARM."""
    seeds: tuple[int, ...] = (0, 1, 2)
    config: Mapping[str, Any] | None = None
    """Values that the figures depend on besides the code, JSON-able. Changed values restart the benchmark."""
    decided_by: tuple[str, ...] | None = None
    """The code that decides the figures of a study of quality: modules and packages by full name, and single
    definitions as MODULE:NAME. None: the figures are speeds, which depend on commit and machine."""


def run_benchmark(
    name: str,
    benchmark: Benchmark,
    folder: Path,
    *,
    arms: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    say: Callable[[str], None] = print,
) -> Path:
    """Run the missing measurements of a benchmark; return the path of its results, `folder`/NAME.json.

    Args:
        arms: only these; None means all.
        seeds: only these; None means all.
        say: called with one line about each measurement.

    Raises:
        InputError: on an arm or a seed that the benchmark does not have.
    """
    for kind, requested, available in (("arm", arms, benchmark.arms), ("seed", seeds, benchmark.seeds)):
        if unknown := [str(value) for value in requested or () if value not in available]:
            raise InputError(
                f"{name} has no {kind} {', '.join(unknown)}; it has {', '.join(map(str, available))}"
            )
    path = folder / f"{name}.json"
    origin = collect_provenance()
    same = _identity(benchmark, origin)
    if _kept_runs(path, same, benchmark, origin) is None:
        say(f"{path.name}: measured on other code, configuration or machine; starting anew")
    chosen = [arm for arm in benchmark.arms if arms is None or arm in arms]
    # Seeds are the outer loop, so that an interrupted benchmark has the same seeds for all arms
    for seed, arm in product([seed for seed in benchmark.seeds if seeds is None or seed in seeds], chosen):
        # The file is read again before each measurement: another process may fill it at the same time
        runs = _kept_runs(path, same, benchmark, origin) or []
        if any(run["arm"] == arm and run["seed"] == seed for run in runs):
            say(f"{name}: {arm}, seed {seed}: measured before")
            continue
        say(f"{name}: {arm}, seed {seed} …")
        started = time.perf_counter()
        figures = {key: float(value) for key, value in benchmark.arms[arm](seed).items()}
        wall_s = time.perf_counter() - started
        made_on = {key: origin[key] for key in MADE_ON}
        # Other processes may have added measurements while this one ran
        lock = path.with_name(f".{path.name}.lock")
        with FileLock(lock):
            runs = _kept_runs(path, same, benchmark, origin) or []
            runs.append({"arm": arm, "seed": seed, "figures": figures, "wall_s": wall_s, **made_on})
            write_json(path, _report(name, benchmark, origin, same, runs))
            lock.unlink()
        say(f"{name}: {arm}, seed {seed}: " + ", ".join(f"{k} {v:.4g}" for k, v in figures.items()))
    if not path.is_file():
        raise InputError(f"{name} has no arms or no seeds")
    return path


def measured_before(name: str, benchmark: Benchmark, folder: Path) -> set[tuple[str, int]]:
    """Return the arms and seeds of a benchmark that need not be measured again."""
    origin = collect_provenance()
    runs = _kept_runs(folder / f"{name}.json", _identity(benchmark, origin), benchmark, origin)
    return {(run["arm"], run["seed"]) for run in runs or []}


def spread(runs: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Return mean, standard deviation (of a sample), minimum, maximum and number per arm and figure.

    Figures of the parts of an arm, ARM@PART, are those of ARM.
    """
    by_arm: dict[str, dict[str, list[float]]] = {}
    for run in runs:
        for key, value in run["figures"].items():
            if value is not None:
                by_arm.setdefault(run["arm"].partition("@")[0], {}).setdefault(key, []).append(value)
    return {
        arm: {
            key: {
                "mean": mean(values),
                "std": stdev(values) if len(values) > 1 else 0.0,
                "min": min(values),
                "max": max(values),
                "n": len(values),
            }
            for key, values in figures.items()
        }
        for arm, figures in by_arm.items()
    }


def _report(
    name: str,
    benchmark: Benchmark,
    origin: Mapping[str, Any],
    same: str,
    runs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    return {
        "name": name,
        "question": benchmark.question,
        "figures": spread(runs),
        "config": dict(benchmark.config or {}),
        "identity": same,
        **origin,
        "runs": list(runs),
    }


def _identity(benchmark: Benchmark, origin: Mapping[str, Any]) -> str:
    """Return a digest of all facts that make two measurements comparable."""
    if benchmark.decided_by is not None:
        return study_identity(benchmark.config or {}, benchmark.decided_by)
    # Speeds depend on machine, versions and commit. The command is left out: it may name single arms
    parts = {key: value for key, value in origin.items() if key != "command"}
    parts["config"] = dict(benchmark.config or {})
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def study_identity(config: Mapping[str, Any], decided_by: Sequence[str]) -> str:
    """Return a digest of a configuration and of the code of modules, without comments and docstrings.

    Entries of the configuration that are None, False or empty count as absent: an option that is added, and
    is off, restarts no study.

    Args:
        config: JSON-able values.
        decided_by: modules and packages by full name; a package stands for all modules in it. MODULE:NAME
            is a function, class or constant with what it uses of its own module.

    Raises:
        ImportError: there is no such module or definition.
    """
    digest = hashlib.sha256(json.dumps(_without_absent(config), sort_keys=True).encode())
    for entry in sorted(decided_by):
        module, _, definition = entry.partition(":")
        for path in _sources(module):
            tree = _without_docstrings(path)
            code = ast.dump(tree) if not definition else _slice(tree, definition, entry)
            digest.update(f"{entry}/{path.name}".encode() + code.encode())
    return digest.hexdigest()[:16]


def _without_absent(value: Any) -> Any:
    """Return JSON-able values without the entries of mappings that are None, False or empty."""
    if isinstance(value, Mapping):
        kept = {str(key): _without_absent(entry) for key, entry in value.items()}
        return {key: entry for key, entry in kept.items() if not _is_absent(entry)}
    if isinstance(value, list | tuple):
        return [_without_absent(entry) for entry in value]
    return value


def _is_absent(value: Any) -> bool:
    return value is None or value is False or (isinstance(value, dict | list | str) and not value)


def _sources(name: str) -> list[Path]:
    """Return the files of a module or package."""
    spec = importlib.util.find_spec(name)
    if spec is None or spec.origin is None:
        raise ImportError(f"no module {name!r}")
    path = Path(spec.origin)
    return sorted(path.parent.rglob("*.py")) if path.name == "__init__.py" else [path]


def _without_docstrings(path: Path) -> ast.Module:
    """Return the syntax tree of a file without its docstrings."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [part for part in node.body if not _is_text(part)]
    return tree


def _slice(tree: ast.Module, definition: str, entry: str) -> str:
    """Return the code of a definition of a module, and of all that it uses of the same module.

    Raises:
        ImportError: the module has no such definition.
    """
    nodes: dict[str, list[ast.stmt]] = {}
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.asname or alias.name.partition(".")[0] for alias in node.names]
        else:
            names = [part.id for part in ast.walk(node) if _is_bound(part)]
        for name in names:
            nodes.setdefault(name, []).append(node)
    if definition not in nodes:
        raise ImportError(f"no definition {entry!r}")
    # Every name that a part reads, as far as this module defines it
    used, waiting = {definition}, [definition]
    while waiting:
        for node in nodes[waiting.pop()]:
            read = {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
            waiting += (read & nodes.keys()) - used
            used |= read & nodes.keys()
    kept = {id(node) for name in used for node in nodes[name]}
    return "".join(ast.dump(node) for node in tree.body if id(node) in kept)


def _is_bound(node: ast.AST) -> TypeGuard[ast.Name]:
    """Return whether a part of a statement is a name that gets a value."""
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)


def _is_text(node: ast.stmt) -> bool:
    """Return whether a statement is a string alone: a docstring."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _kept_runs(
    path: Path, same: str, benchmark: Benchmark, origin: Mapping[str, Any]
) -> list[dict[str, Any]] | None:
    """Return the earlier runs, each with its commit and machine. None if they are of other code or values."""
    if not path.is_file():
        return []
    try:
        earlier = json.loads(path.read_text())
        runs = [
            run for run in earlier["runs"] if run["arm"] in benchmark.arms and run["seed"] in benchmark.seeds
        ]
        identity = earlier["identity"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a benchmark's results; move it away to start anew") from error
    if identity == same:
        # Runs without entries of their own take those of the file
        made_on = {key: earlier.get(key, origin[key]) for key in MADE_ON}
        return [made_on | run for run in runs]
    return None
