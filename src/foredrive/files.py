"""Atomic writing: a file under its final name is always complete."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from foredrive.errors import InputError

WHILE_WRITING = "while writing "
"""Prefix of the note that `naming` adds to an error. The path follows."""


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
    unchanged.

    Raises:
        InputError: the parent folder cannot be created.
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
