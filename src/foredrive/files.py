"""Atomic writing: a file under its final name is always complete."""

import contextlib
import fcntl
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

from foredrive.errors import InputError

WHILE_WRITING = "while writing "
"""Prefix of the note that `naming` adds to an error. The path follows."""


_HOST = re.sub(r"\W", "_", socket.gethostname())
_SCRATCH = re.compile(rf"\.(?P<final>.+)\.{_HOST}-(?P<process>\d+)-[^.]*\.part")
"""Name of a scratch folder of this machine: what is written, and the process that writes it."""
_REPLACED = "replaced"
"""Name that a folder gets in the scratch folder of the one that replaces it."""
_tidied: set[Path] = set()
"""Folders in which this process has looked for scratch folders of killed processes."""


@contextlib.contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Add the path being written to errors of the block (e.g. a full disk).

    Such an error may otherwise name a scratch file, or no file.
    """
    try:
        yield
    except Exception as error:
        error.add_note(f"{WHILE_WRITING}{path}")
        raise


def make_folder(folder: Path) -> None:
    """Create a folder and its parents, unless it exists.

    Raises:
        InputError: no folder can exist there, as below /proc.
        OSError: the operating system refuses it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileNotFoundError:
        raise InputError(f"{folder}: no folder can be made there") from None


@contextlib.contextmanager
def atomic_path(final: Path, *, alone: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `final`, and rename it to `final` if the block succeeds.

    The block may create a file or a folder at the temporary path. An existing file or folder at `final` is
    replaced. If the block raises (a full disk, Ctrl-C), everything written is removed and `final` is
    unchanged. What a killed process left is removed when the next one writes to the same folder.

    Args:
        final: path of the file or folder.
        alone: whether to refuse if another process of this machine is writing the same path. It is for what
            takes long to write; of small files the last one written stays.

    Raises:
        InputError: the parent folder cannot be created, or another process is writing `final`.
    """
    final = Path(final)
    with naming(final):
        make_folder(final.parent)
        scratch, lock = _new_scratch(final, alone)
        temporary = scratch / final.name
        try:
            yield temporary
            if temporary.is_dir() and final.is_dir():
                final.rename(scratch / _REPLACED)
            os.replace(temporary, final)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
            _unlock(lock)


def remove_abandoned(folder: Path, *, below: bool = False) -> None:
    """Remove what killed processes of this machine left half-written in a folder.

    It looks once in the life of this process. A folder that was being replaced by another, which was whole,
    is replaced by it.

    Args:
        folder: may not exist.
        below: whether all folders in it are looked at too.
    """
    for at in _folders_below(folder) if below else (folder,):
        if at in _tidied:
            continue
        with contextlib.suppress(FileNotFoundError):
            lock = _lock(at, wait=True)
            try:
                _remove_abandoned(at)
            finally:
                _unlock(lock)


def _folders_below(folder: Path) -> Iterator[Path]:
    for found, folders, _ in os.walk(folder):
        folders[:] = [name for name in folders if _SCRATCH.fullmatch(name) is None]
        yield Path(found)


def _new_scratch(final: Path, alone: bool) -> tuple[Path, int | None]:
    """Make a scratch folder; return it and its lock, which tells others that its process lives."""
    among = None
    if not _SCRATCH.fullmatch(final.parent.name):  # the lock of a scratch folder is this process' own
        among = _lock(final.parent, wait=True)  # nobody takes the new folder for abandoned before its lock
    try:
        _remove_abandoned(final.parent, again=alone)
        for _, name in _scratch_folders(final.parent) if alone else ():
            if name["final"] == final.name:
                raise InputError(
                    f"{final}: another process ({name['process']}) is writing it; wait for it or end it"
                )
        prefix = f".{final.name}.{_HOST}-{os.getpid()}-"
        scratch = Path(tempfile.mkdtemp(prefix=prefix, suffix=".part", dir=final.parent))
        return scratch, _lock(scratch)
    finally:
        _unlock(among)


def _remove_abandoned(folder: Path, *, again: bool = False) -> None:
    """Remove the scratch folders of this machine's dead processes, only once if not `again`."""
    if folder in _tidied and not again:
        return
    _tidied.add(folder)
    for scratch, name in _scratch_folders(folder):
        try:
            lock = _lock(scratch)
        except (BlockingIOError, FileNotFoundError):  # it is being written, or has just been finished
            continue
        if lock is not None or not _lives(int(name["process"])):
            final = folder / name["final"]
            if (scratch / _REPLACED).exists() and not final.exists():  # killed between two renames
                os.replace(scratch / name["final"], final)
            shutil.rmtree(scratch, ignore_errors=True)
        _unlock(lock)


def _scratch_folders(folder: Path) -> list[tuple[Path, re.Match[str]]]:
    with os.scandir(folder) as entries:
        return [(Path(entry.path), name) for entry in entries if (name := _SCRATCH.fullmatch(entry.name))]


def _lock(folder: Path, *, wait: bool = False) -> int | None:
    """Lock a folder until the returned descriptor is closed, at the latest when this process ends in any way.

    A process number would not do: in containers the next process often has that of the killed one.

    Returns:
        None if the file system does not lock folders.

    Raises:
        BlockingIOError: another has locked it, and `wait` is not set.
        FileNotFoundError: there is no such folder.
    """
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        os.close(lock)
        if isinstance(error, BlockingIOError):
            raise
        return None
    except BaseException:  # Ctrl-C while it waits
        os.close(lock)
        raise
    return lock


def _unlock(lock: int | None) -> None:
    if lock is not None:
        os.close(lock)


def _lives(process: int) -> bool:
    """Return whether a process of this machine exists."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it belongs to someone else
        pass
    return True
