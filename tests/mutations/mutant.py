"""Faults listed in `faults.toml`, each put into a copy of the package in which its tests run.

mutmut and cosmic-ray swap operators by the thousand and run the whole suite for each. The faults here are
some dozens that a careful author could commit, often of several tokens, each beside the tests that notice it.
"""

import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
PACKAGE = REPOSITORY / "src" / "foredrive"
NUMBA_CACHES = "*.nb[ic]"


@dataclass(frozen=True)
class Fault:
    """One wrong edit of the package."""

    what: str
    file: str
    """Below `src/foredrive`."""
    original: str
    """Occurs exactly once in the file."""
    faulty: str
    tests: tuple[str, ...]
    """Files or tests below `tests`, as pytest takes them."""


def read_faults() -> list[Fault]:
    """Return the listed faults."""
    listed = tomllib.loads((HERE / "faults.toml").read_text())["fault"]
    return [Fault(**{**row, "tests": tuple(row["tests"])}) for row in listed]


def occurrences(fault: Fault) -> int:
    """Return how often the fault's original text stands in its file; 0 without the file."""
    path = PACKAGE / fault.file
    return path.read_text().count(fault.original) if path.is_file() else 0


def copy_package(folder: Path) -> Path:
    """Copy the package into a folder, without compiled kernels, which may be of other sources."""
    shutil.copytree(PACKAGE, folder / "foredrive", ignore=shutil.ignore_patterns(NUMBA_CACHES))
    return folder


def copy_with_fault(fault: Fault, sound: Path, folder: Path) -> Path:
    """Copy a sound package into a folder and put a fault into it.

    Its kernels are compiled again if the fault's file has any: other kernels contain them.
    """
    source = (sound / "foredrive" / fault.file).read_text()
    left_out = [NUMBA_CACHES] if "numba" in source else []
    shutil.copytree(sound / "foredrive", folder / "foredrive", ignore=shutil.ignore_patterns(*left_out))
    (folder / "foredrive" / fault.file).write_text(source.replace(fault.original, fault.faulty))
    return folder


def run_tests(tests: Iterable[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run tests of the repository, up to the first failure, with the package in a folder."""
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "-p", "no:xdist"]
        + [str(REPOSITORY / "tests" / test) for test in tests],
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
