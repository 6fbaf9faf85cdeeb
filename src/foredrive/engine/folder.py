"""Run folders: one process writes at a time, an interrupted run continues, and the commit is noted."""

import contextlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from foredrive.engine.provenance import COMMIT
from foredrive.errors import InputError
from foredrive.files import atomic_path, make_folder, remove_abandoned, together

CONFIG, LOGS, LOG, WEIGHTS, SUMMARY = (
    "config.yaml",
    "logs.json",
    "log.json",
    "model.safetensors",
    "summary.json",
)
"""Files of training runs and reconstructions: the recipe, the logs, the log, the weights, the metrics."""
RECIPE = "recipe.json"
"""File of retrieval towers: the recipe and the logs."""
SUITE, DRIVES = "suite.json", "drives"
"""Files of a suite of drives: the suite's file, and the folder with a file for each drive."""
MADE_BY = "made_by.json"
"""File that notes the commit with which a run began."""
LOCK = ".lock"
"""Lock file. The operating system releases the lock when its process ends in any way, so a killed process
does not block the folder.
"""
RESULTS_LOCK = ".results.lock"
"""Lock file of results that are written in one go. A run may be evaluated while it is being trained."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunFolder:
    """A folder that is filled step by step and can be continued after an interruption."""

    path: Path
    wanted: Mapping[str, object]
    """The request. The keys complete the message "PATH: holds ..." if the folder holds something else."""
    read: Callable[[], Mapping[str, object] | None]
    """Returns the request with which the folder began, with the same keys; None: the folder is new."""
    write: Callable[[], None]
    """Writes the request to the folder."""
    grows: bool = False
    """Whether the request may grow later; it is then written each time."""

    def check(self) -> bool:
        """Return whether the folder was begun with the same request.

        Raises:
            InputError: it holds something else.
        """
        stored = self.read()
        for what, value in self.wanted.items() if stored is not None else ():
            if stored.get(what) != value:  # type: ignore[union-attr]
                raise InputError(f"{self.path}: holds {what}; choose another folder")
        return stored is not None

    @contextlib.contextmanager
    def claimed(self) -> Iterator[None]:
        """Begin or continue the folder, and keep other processes from writing to it meanwhile.

        Raises:
            InputError: it holds something else, or another process writes to it.
        """
        with held(self.path):
            begun = self.check()
            _log.info("%s: %s", self.path, "goes on" if begun else "begins")
            # Before the request is written: the request marks the folder as begun
            self._mark(begun)
            if not begun or self.grows:
                self.write()
            yield

    def _mark(self, begun: bool) -> None:
        """Note the commit with which a run begins; warn if the run continues with another commit."""
        file = self.path / MADE_BY
        if not begun:
            with atomic_path(file) as temporary:
                temporary.write_text(json.dumps({"commit": COMMIT}) + "\n")
            return
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError):  # Runs may lack the file
            commit = json.loads(file.read_text())["commit"]
            if commit != COMMIT:
                _log.warning(
                    "%s: begun with the code of %s, goes on with that of %s", self.path, commit, COMMIT
                )


def by_contents(noted: Mapping[str, object], what: str, contents: Mapping[str, str]) -> dict[str, object]:
    """Return a request for `RunFolder.wanted`, with the digests of files apart from all else.

    Args:
        noted: the request as it is stored.
        what: completes the message where other entries differ.
        contents: completes the message for each entry that is a digest.
    """
    others = {key: value for key, value in noted.items() if key not in contents}
    return {what: others, **{text: noted.get(key) for key, text in contents.items()}}


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep other processes from writing to a folder; create it if it does not exist.

    Unfinished files of killed processes in it are removed.

    Raises:
        InputError: another process writes to it.
    """
    make_folder(folder)
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise InputError(f"{folder}: another process is writing to it; wait for it or end it") from None
    try:
        # With the lock held no other process of this kind writes here, so unfinished files have no owner
        remove_abandoned(folder, below=True)
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def held_for_results(folder: Path) -> Iterator[None]:
    """Keep other processes from writing results to a folder. Nothing but the results stays in it.

    The files directly in the folder appear together at the end of the block, or none of them.

    Raises:
        InputError: another process writes results to it.
    """
    was_there = folder.is_dir()
    make_folder(folder)
    lock = FileLock(folder / RESULTS_LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise InputError(
            f"{folder}: another process is writing results to it; wait for it or end it"
        ) from None
    try:
        remove_abandoned(folder)
        with together(folder):
            yield
    finally:
        (folder / RESULTS_LOCK).unlink(missing_ok=True)
        lock.release()
        if not was_there:
            with contextlib.suppress(OSError):  # It holds results, so it stays
                folder.rmdir()
