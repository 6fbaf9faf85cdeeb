"""Writing to disk so that a file under its final name is always whole."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

WHILE_WRITING = "while writing "
"""Starts the note that `atomic_path` adds to an error; the final path follows."""


@contextlib.contextmanager
def atomic_path(final: Path) -> Iterator[Path]:
    """Yield a temporary path beside `final` and rename it there when the block ends well.

    The block may make the temporary path a file or a folder; an existing file under the final name is
    replaced, an existing folder too. If the block raises (a full disk, Ctrl-C), whatever was written is
    removed and the final name is left as it was.
    """
    final = Path(final)
    final.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{final.name}.", suffix=".part", dir=final.parent))
    temporary = scratch / final.name
    try:
        yield temporary
        if temporary.is_dir() and final.is_dir():
            final.rename(scratch / "replaced")
        os.replace(temporary, final)
    except Exception as error:  # a full disk is reported by what was to be written, not by a scratch name
        error.add_note(f"{WHILE_WRITING}{final}")
        raise
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
