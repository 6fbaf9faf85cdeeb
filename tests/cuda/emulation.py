"""An emulated CUDA device: tensors that say they are on a card, obey CUDA's rules and compute on the CPU.

A program that mixes devices, reads a tensor of the card into NumPy or draws random numbers with a generator
of the CPU fails here as it fails on a card. Values are those of the CPU, so both devices can be compared.
Copies between the devices, and operations for which the host waits, are counted by the line that asks.

A program begins with `start`, before PyTorch is imported for the first time, then `emulated_card.begin`. Both
hold for the whole process, so each program runs in a process of its own.
"""

import collections
import ctypes
import hashlib
import importlib.util
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

HOOKS = Path(__file__).with_name("hooks.cpp")
PACKAGE = f"{os.sep}foredrive{os.sep}"


def built_hooks(folder: Path) -> Path:
    """Compile the answers of the device against the installed PyTorch, unless they are there."""
    (torch,) = importlib.util.find_spec("torch").submodule_search_locations  # type: ignore[union-attr]
    version = Path(torch, "version.py").read_bytes() + sysconfig.get_platform().encode()
    digest = hashlib.sha256(HOOKS.read_bytes() + version).hexdigest()[:16]
    built = folder / f"cuda_hooks_{digest}.so"
    if not built.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        scratch = built.with_suffix(f".{os.getpid()}")
        command = ["g++", "-O0", "-shared", "-fPIC", "-std=c++20", f"-I{torch}/include", str(HOOKS)]
        subprocess.run([*command, "-o", str(scratch)], check=True, capture_output=True)
        scratch.replace(built)
    return built


def start(hooks: Path) -> None:
    """Load PyTorch's libraries with the answers of the device. Then `emulated_card.begin` may follow."""
    assert "torch" not in sys.modules, "the hooks are registered before PyTorch starts"
    (torch,) = importlib.util.find_spec("torch").submodule_search_locations  # type: ignore[union-attr]
    for name in ("libc10.so", "libtorch_cpu.so"):
        ctypes.CDLL(f"{torch}/lib/{name}", ctypes.RTLD_GLOBAL)
    ctypes.CDLL(str(hooks))


class Counts:
    """Waits of the host and copies between the devices, by their kind and the line of the package."""

    def __init__(self) -> None:
        self.by_line: collections.Counter[tuple[str, str]] = collections.Counter()

    def note(self, kind: str) -> None:
        """Count one."""
        frame = sys._getframe(1)
        while frame is not None and PACKAGE not in frame.f_code.co_filename:
            frame = frame.f_back  # type: ignore[assignment]
        line = "elsewhere"
        if frame is not None:
            line = f"{frame.f_code.co_filename.rpartition(PACKAGE)[2]}:{frame.f_lineno}"
        self.by_line[kind, line] += 1

    def of(self, kind: str) -> int:
        """Return how many of a kind there were."""
        return sum(count for (this, _), count in self.by_line.items() if this == kind)


WAIT, TO_CARD, TO_HOST = "wait", "copy to the card", "copy to the host"
