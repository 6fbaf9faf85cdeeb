"""Measure time and memory of code on the CPU or a GPU, each measurement in its own process."""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import torch
from torch import Tensor

CHECKOUT = Path(__file__).parents[2]
"""Folder of the package `benchmarks`."""


def in_a_process(program: str, *arguments: str) -> dict[str, float]:
    """Run `program`, a Python file that prints metrics as JSON; return them. Numba compiles again there."""
    path = os.pathsep.join(filter(None, (str(CHECKOUT), os.environ.get("PYTHONPATH"))))
    with tempfile.TemporaryDirectory() as empty_cache:
        done = subprocess.run(
            [sys.executable, program, *arguments],
            env=os.environ | {"NUMBA_CACHE_DIR": empty_cache, "PYTHONPATH": path},
            stdout=subprocess.PIPE,
            check=True,
            text=True,
        )
    return {name: float(value) for name, value in json.loads(done.stdout).items()}


class Took(NamedTuple):
    """Median times over several calls."""

    wall_s: float
    cpu_s: float
    """CPU time of all threads of this process, s; other programs on the machine affect it less."""


def measure(call: Callable[[], object], times: int, device: str) -> Took:
    """Measure the time of a call; each call ends when the GPU has finished."""
    took = [_measure_one(call, device) for _ in range(times)]
    return Took(median(one.wall_s for one in took), median(one.cpu_s for one in took))


def _measure_one(call: Callable[[], object], device: str) -> Took:
    _finish(device)
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    call()
    _finish(device)
    return Took(time.perf_counter() - wall_s, time.process_time() - cpu_s)


def measure_op(
    op: Callable[..., Tensor], inputs: Sequence[Tensor], times: int, device: str
) -> dict[str, float]:
    """Return median times of an op and its gradients, ms, and their peak memory above the inputs, MiB."""
    inputs = [x.requires_grad_() for x in inputs]
    forget_peak(device)
    before_mib = held_mib(device)
    out = op(*inputs)
    torch.autograd.grad(out, inputs, torch.ones_like(out))
    del out
    peak = peak_mib(device) - before_mib
    out = op(*inputs)
    upstream = torch.ones_like(out)
    forward = measure(lambda: op(*inputs), times, device)
    backward = measure(lambda: torch.autograd.grad(out, inputs, upstream, retain_graph=True), times, device)
    return {
        "forward_ms": 1e3 * forward.wall_s,
        "backward_ms": 1e3 * backward.wall_s,
        "forward_cpu_ms": 1e3 * forward.cpu_s,
        "backward_cpu_ms": 1e3 * backward.cpu_s,
        "peak_mib": peak,
    }


def compare(fast: Mapping[str, float], reference: Mapping[str, float]) -> dict[str, float]:
    """Return the metrics of `measure_op` of two paths side by side, with their ratios."""
    figures = {f"fast.{key}": value for key, value in fast.items()}
    figures |= {f"reference.{key}": value for key, value in reference.items()}
    for name, unit in (("speedup", "ms"), ("speedup_cpu", "cpu_ms")):
        took = [path[f"forward_{unit}"] + path[f"backward_{unit}"] for path in (reference, fast)]
        figures[name] = took[0] / took[1]
    figures["memory_ratio"] = fast["peak_mib"] / reference["peak_mib"]
    return figures


def forget_peak(device: str) -> None:
    """Reset the peak that `peak_mib` returns."""
    if device == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    else:
        Path("/proc/self/clear_refs").write_text("5")


def held_mib(device: str) -> float:
    """Return the memory that torch holds on the GPU, or the resident memory of this process, MiB."""
    return torch.cuda.memory_reserved() / 2**20 if device == "cuda" else _status_mib("VmRSS")


def peak_mib(device: str) -> float:
    """Return the peak memory since `forget_peak`, MiB."""
    return torch.cuda.max_memory_reserved() / 2**20 if device == "cuda" else _status_mib("VmHWM")


def _finish(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def _status_mib(field: str) -> float:
    found = re.search(rf"{field}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1024
