"""Folders that hold what a verb makes: one process at a time, and only what they were begun with."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from foredrive.errors import InputError
from foredrive.files import make_folder

LOCK = ".lock"
"""Held by the operating system for as long as its process lives: a killed one leaves the folder free."""
_RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID")
"""How processes that train together are told apart; the first of them holds the lock for all."""


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
