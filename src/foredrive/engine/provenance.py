"""Provenance of figures: machine, versions, commit, command, memory."""

import hashlib
import os
import platform
import resource
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import torch

import foredrive
from foredrive.engine.summary import Figures

GIB = 1024**3
CODE = ("--", "src", "pyproject.toml")
"""Paths that figures depend on, as arguments to git."""


def collect_provenance() -> Figures:
    """Return the facts needed to repeat a measurement, as flat dotted keys."""
    return {
        "machine.cpu": _cpu_model(),
        "machine.cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "machine.ram_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB, 1),
        "machine.gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "version.foredrive": metadata.version("foredrive"),
        "version.python": platform.python_version(),
        "version.torch": torch.__version__,
        "commit": COMMIT,
        "command": command_line(),
    }


def command_line() -> str:
    """Return the command of this process, without the folder of its program."""
    program = Path(sys.argv[0])
    name = f"python -m {program.parent.name}" if program.name == "__main__.py" else program.name
    return " ".join([name, *map(shlex.quote, sys.argv[1:])])


def git_commit(checkout: Path) -> str | None:
    """Return the commit of a checkout; None for other folders.

    Where the code differs from the commit, "+" and a digest of the difference follow: two measurements are of
    the same code if and only if the strings are equal.
    """
    if not (checkout / ".git").exists():
        return None
    commit = _git(checkout, "rev-parse", "--short=12", "HEAD")
    changed = _git(checkout, "status", "--porcelain", "--untracked-files=all", *CODE)
    if commit is None or not changed:
        return commit
    # `git diff` shows tracked files only, so the content of new files is added
    digest = hashlib.sha256((_git(checkout, "diff", "HEAD", *CODE) or "").encode())
    for line in changed.splitlines():
        if line.startswith("?? "):
            digest.update(line.encode() + (checkout / line[3:].strip('"')).read_bytes())
    return f"{commit}+{digest.hexdigest()[:8]}"


def peak_rss_gib() -> float:
    """Return the peak resident memory of this process, GiB, without worker processes."""
    status = Path("/proc/self/status")
    if status.is_file():  # getrusage would include the memory of the parent process
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / GIB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # macOS reports bytes, other systems KiB
    return peak / GIB if sys.platform == "darwin" else peak * 1024 / GIB


def _git(folder: Path, *arguments: str) -> str | None:
    """Return the output of git, None if it cannot run."""
    try:
        answer = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True, timeout=60
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip("\n")


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


COMMIT = git_commit(Path(foredrive.__file__).parents[2])
"""Commit of the running code. It is read at the start: the checkout may change before figures are written."""
