"""Folders that runs are made in: one process at a time, gone on with by who asks for the same, and marked."""

import contextlib
import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from foredrive.errors import InputError
from foredrive.evaluation.provenance import COMMIT
from foredrive.files import atomic_path, make_folder

CONFIG, LOGS, LOG, WEIGHTS, SUMMARY = (
    "config.yaml",
    "logs.json",
    "log.json",
    "model.safetensors",
    "summary.json",
)
"""Of training runs and reconstructions: the recipe, the log or logs, what was learned, how good it is."""
RECIPE = "recipe.json"
"""Of towers: the recipe and the logs."""
SUITE, DRIVES = "suite.json", "drives"
"""Of drives: who drives what, and a file for each drive."""
MADE_BY = "made_by.json"
"""The code that a run was begun with."""
LOCK = ".lock"
"""Held by the operating system for as long as its process lives: a killed one leaves the folder free."""
_RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID")
"""How processes that train together are told apart; the first of them holds the lock for all."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunFolder:
    """A folder that something is made in step by step, and gone on with after an interruption."""

    path: Path
    wanted: Mapping[str, object]
    """What is asked for; the keys complete "PATH: holds ..." where a folder holds something else."""
    read: Callable[[], Mapping[str, object] | None]
    """What was asked for when the folder was begun, by the same keys; None: nothing was."""
    write: Callable[[], None]
    """Note what is asked for."""
    grows: bool = False
    """Whether more may be asked for later: it is noted each time."""

    def check(self) -> bool:
        """Whether the folder has been begun, with the same.

        Raises:
            InputError: it holds something else.
        """
        found = self.read()
        for what, value in self.wanted.items() if found is not None else ():
            if found.get(what) != value:  # type: ignore[union-attr]
                raise InputError(f"{self.path}: holds {what}; choose another folder")
        return found is not None

    @contextlib.contextmanager
    def claimed(self) -> Iterator[None]:
        """Begin the folder or go on with it, and keep other processes from writing to it meanwhile.

        Raises:
            InputError: it holds something else, or another process writes to it.
        """
        with held(self.path):
            if not (begun := self.check()) or self.grows:
                self.write()
            self._mark(begun)
            yield

    def _mark(self, begun: bool) -> None:
        """Keep the commit that a run was begun with; say so if it goes on under another."""
        file = self.path / MADE_BY
        if not begun:
            with atomic_path(file) as temporary:
                temporary.write_text(json.dumps({"commit": COMMIT}) + "\n")
            return
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError):  # older runs have no mark
            commit = json.loads(file.read_text())["commit"]
            if commit != COMMIT:
                _log.warning(
                    "%s: begun with the code of %s, goes on with that of %s", self.path, commit, COMMIT
                )


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep other processes from writing to a folder, which is made if need be.

    Raises:
        InputError: another process writes to it.
    """
    if any(os.environ.get(rank, "0") != "0" for rank in _RANKS):
        yield
        return
    make_folder(folder)
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise InputError(f"{folder}: another process is writing to it; wait for it or end it") from None
    try:
        yield
    finally:
        lock.release()
