"""Faults listed in `faults.toml`, each put into a copy of the package in which its tests run.

mutmut and cosmic-ray swap operators by the thousand and run the whole suite for each. The faults here are
some dozens that a careful author could commit, often of several tokens, each beside the tests that notice it.
"""

import os
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
PACKAGE = REPOSITORY / "src" / "foredrive"


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


def faults() -> list[Fault]:
    """Return the listed faults."""
    listed = tomllib.loads((HERE / "faults.toml").read_text())["fault"]
    return [Fault(**{**row, "tests": tuple(row["tests"])}) for row in listed]


def occurrences(fault: Fault) -> int:
    """Return how often the fault's original text stands in its file; 0 without the file."""
    path = PACKAGE / fault.file
    return path.read_text().count(fault.original) if path.is_file() else 0


def run_tests_with(fault: Fault, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the fault's tests up to the first failure, on a copy of the package in `folder` that has the fault.

    Numba's caches are not copied for a fault in a file with kernels: others contain them, as they were.
    """
    copy = folder / "foredrive"
    source = (PACKAGE / fault.file).read_text()
    stale = ("*.nb[ic]",) if "numba" in source else ()
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns(*stale))
    (copy / fault.file).write_text(source.replace(fault.original, fault.faulty))
    tests = [str(REPOSITORY / "tests" / test) for test in fault.tests]
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", *tests],
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
