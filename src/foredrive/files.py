"""Writing to disk so that a file under its final name is always whole."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from foredrive.errors import InputError

WHILE_WRITING = "while writing "
"""Starts the note that `naming` adds to an error; the path follows."""


@contextlib.contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Note on errors of the block (a full disk) what it writes: they may name a scratch file, or nothing."""
    try:
        yield
    except Exception as error:
        error.add_note(f"{WHILE_WRITING}{path}")
        raise


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, unless it is there.

    Raises:
        InputError: there can be none, as below /proc.
        OSError: the disk refuses it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileNotFoundError:
        raise InputError(f"{folder}: no folder can be made there") from None


@contextlib.contextmanager
def atomic_path(final: Path) -> Iterator[Path]:
    """Yield a temporary path beside `final` and rename it there when the block ends well.

    The block may make the temporary path a file or a folder; an existing file under the final name is
    replaced, an existing folder too. If the block raises (a full disk, Ctrl-C), whatever was written is
    removed and the final name is left as it was.

    Raises:
        InputError: its folder cannot be made.
    """
    final = Path(final)
    with naming(final):
        make_folder(final.parent)
        scratch = Path(tempfile.mkdtemp(prefix=f".{final.name}.", suffix=".part", dir=final.parent))
        temporary = scratch / final.name
        try:
            yield temporary
            if temporary.is_dir() and final.is_dir():
                final.rename(scratch / "replaced")
            os.replace(temporary, final)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
