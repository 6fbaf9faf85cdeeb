"""Atomic writing: a file under its final name is always complete."""

import contextlib
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
_SCRATCH = re.compile(rf"\..+\.{_HOST}-(\d+)-[^.]*\.part")
"""Name of a scratch folder of this machine. The number is the process that writes to it."""
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
def atomic_path(final: Path) -> Iterator[Path]:
    """Yield a temporary path beside `final`, and rename it to `final` if the block succeeds.

    The block may create a file or a folder at the temporary path. An existing file or folder at `final` is
    replaced. If the block raises (a full disk, Ctrl-C), everything written is removed and `final` is
    unchanged. What a killed process left is removed when the next one writes to the same folder.

    Raises:
        InputError: the parent folder cannot be created.
    """
    final = Path(final)
    with naming(final):
        make_folder(final.parent)
        _remove_abandoned(final.parent)
        prefix = f".{final.name}.{_HOST}-{os.getpid()}-"
        scratch = Path(tempfile.mkdtemp(prefix=prefix, suffix=".part", dir=final.parent))
        temporary = scratch / final.name
        try:
            yield temporary
            if temporary.is_dir() and final.is_dir():
                final.rename(scratch / "replaced")
            os.replace(temporary, final)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


def _remove_abandoned(folder: Path) -> None:
    """Remove the scratch folders of this machine's dead processes, once in the life of this process."""
    if folder in _tidied:
        return
    _tidied.add(folder)
    with os.scandir(folder) as entries:
        found = [(entry.path, name) for entry in entries if (name := _SCRATCH.fullmatch(entry.name))]
    for path, name in found:
        if not _lives(int(name[1])):
            shutil.rmtree(path, ignore_errors=True)


def _lives(process: int) -> bool:
    """Return whether a process of this machine exists."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it belongs to someone else
        pass
    return True
