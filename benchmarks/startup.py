"""CPU time of the program before its own work: help, a wrong argument, a verb.

Each command is its own process, started several times; the minimum of its CPU seconds (user and system, all
threads) is reported: `foredrive bench startup`.

A verb's own work begins when its modules are imported; the arms called "begin" measure these imports. "import
torch" is the lower bound for most verbs.
"""

import functools
import resource
import subprocess
import sys

from benchmarks.common.benchmark import Benchmark

REPETITIONS = 3
NOWHERE = "/nonexistent"
LINES = {
    "--help": "--help",
    "--version": "--version",
    "search --help": "search --help",
    "record --help": "record --help",
    "wrong: view": f"view {NOWHERE}",
    "wrong: record": f"record --town Town99 --out {NOWHERE}",
    "wrong: train": f"train nemo_tiny --logs {NOWHERE} --out {NOWHERE}",
    "wrong: search": f"search rain --index {NOWHERE}",
    "wrong: reconstruct": f"reconstruct {NOWHERE} --out {NOWHERE}",
    "wrong: drive": f"drive --agent stop --in {NOWHERE} --out {NOWHERE}",
}
IMPORTS = {
    "import torch": "torch",
    "begin: view": "foredrive.view.log_frames",
    "begin: convert": "foredrive.data.formats.convert",
    "begin: record": "foredrive.runs.drive.recording, foredrive.towns.campaign",
    "begin: train": "foredrive.runs.recipes.known, foredrive.runs.train.run",
    "begin: evaluate": "foredrive.runs.evaluate.run",
    "begin: reconstruct": "foredrive.runs.reconstruction.reconstruct",
    "begin: drive": "foredrive.runs.drive.suite",
    "begin: search": "foredrive.runs.search.searching",
}


def _cpu_s(command: list[str]) -> dict[str, float]:
    taken = []
    for _ in range(REPETITIONS + 1):  # the first run writes bytecode
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=False, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        taken.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return {"cpu_s": min(taken[1:]), "most_cpu_s": max(taken[1:])}


def _line(line: str, _: int) -> dict[str, float]:
    return _cpu_s([sys.executable, "-m", "foredrive", *line.split()])


def _import(modules: str, _: int) -> dict[str, float]:
    code = f"from foredrive.lazy import importing\nwith importing():\n    import {modules}"  # as the verbs do
    return _cpu_s([sys.executable, "-c", code])


BENCHMARK = Benchmark(
    question="How much CPU passes until the program helps, refuses a wrong argument, begins a verb's work?",
    arms={
        **{name: functools.partial(_line, line) for name, line in LINES.items()},
        **{name: functools.partial(_import, modules) for name, modules in IMPORTS.items()},
    },
    seeds=(0,),
    config={"repetitions": REPETITIONS, "lines": LINES, "imports": IMPORTS},
)
