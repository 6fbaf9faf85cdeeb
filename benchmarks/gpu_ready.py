"""Counts the paths for GPUs that are checked without one: `foredrive bench gpu-ready`.

`paths` runs the cases of tests/cuda on an emulated card (g++ builds it): those that give the figures of the
CPU are counted, and how often the host waits for the card in a step of training and a plan. `sm_80` and
`sm_90` compile every variant of Triton's kernels for these cards, at the sizes of `nemo_base` and
`field_base`; they need Triton, and no card.
"""

import functools
import importlib
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import CHECKOUT
from foredrive.errors import InputError

CASES = CHECKOUT / "tests" / "cuda" / "cases.py"
WORK = Path("runs/gpu_ready").absolute()
STEPS = ("nemo", "driveworld", "heads")
CLOSE = 1e-2
"""Largest relative difference of a figure, where kernels and plain PyTorch add up in another order."""


def paths(_: int) -> dict[str, float]:
    """Return the number of cases that agree, of all cases, and the waits of a step."""
    sys.path.insert(0, str(CASES.parent))
    emulation = importlib.import_module("emulation")
    hooks = emulation.built_hooks(WORK)
    on_cpu, on_card = (_outcomes([str(CASES), device, str(hooks)]) for device in ("cpu", "cuda"))
    agreeing = [
        name
        for name, outcome in on_card.items()
        if "figures" in outcome
        and all(
            math.isclose(value, on_cpu[name]["figures"][key], rel_tol=CLOSE, abs_tol=1e-5)
            for key, value in outcome["figures"].items()
        )
    ]
    kinds = (emulation.WAIT, emulation.TO_HOST)
    waits = {
        name: sum(n for line, n in on_card[name]["counts"].items() if line.startswith(kinds))
        for name in STEPS
    }
    figures = {f"waits_{name}": float(count) for name, count in waits.items()}
    return figures | {
        "paths_checked": len(agreeing),
        "paths": len(on_card),
        "syncs_per_step": sum(waits.values()) / len(waits),
    }


def kernels(capability: int, _: int) -> dict[str, float]:
    """Return the number of variants of kernels that compile for a card, their largest stack and registers."""
    lines = _lines(["-m", "benchmarks.common.compiled_kernels", str(capability)])
    return {
        "kernels_compiled": len(lines),
        "stack_bytes_max": max(line["stack_bytes"] for line in lines),
        "registers_max": max(line["registers"] for line in lines),
    }


def _outcomes(command: list[str]) -> dict[str, dict[str, Any]]:
    return {line["case"]: line for line in _lines(command)}


def _lines(command: list[str]) -> list[dict[str, Any]]:
    """Return the lines of JSON that a program prints."""
    done = subprocess.run([sys.executable, *command], cwd=CHECKOUT, capture_output=True, text=True)
    if done.returncode:
        raise InputError(done.stderr.strip().splitlines()[-1])
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"case"')]


BENCHMARK = Benchmark(
    question="How far are the paths for GPUs checked without one?",
    arms={"paths": paths, **{f"sm_{card}": functools.partial(kernels, card) for card in (80, 90)}},
    seeds=(0,),
    decided_by=(
        "benchmarks.common.compiled_kernels",
        "foredrive.ops",
        "foredrive.methods",
        "foredrive.engine",
    ),
)
