"""Atomic writing: a file under its final name is always complete."""

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from foredrive.errors import InputError

WHILE_WRITING = "while writing "
"""Prefix of the note that `naming` adds to an error. The path follows."""


_HOST = re.sub(r"\W", "_", socket.gethostname())
_SCRATCH = re.compile(rf"\.(?P<final>.+)\.{_HOST}-(?P<process>\d+)-[^.]*\.part")
"""Name of a scratch folder of this machine, with the final name and the process that writes."""
_TOGETHER, _CLAIMED = "together", " (claimed)"
"""Name of the scratch folder of files that appear together, and end of the name of one that is a claim."""
_REPLACED = "replaced"
"""Folder in a scratch folder. It takes the old folders that are replaced by the new ones beside it."""
_writing: set[Path] = set()
"""Scratch folders of this process."""
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


def digest_of(files: Iterable[Path]) -> str:
    """Return a digest of the names and the contents of files, in their order.

    Raises:
        OSError: a file cannot be read.
    """
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as opened:
            digest.update(f"{file.name} ".encode() + hashlib.file_digest(opened, "sha256").digest())
    return digest.hexdigest()


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
    except FileExistsError:
        if folder.is_symlink() and not folder.exists():
            raise InputError(f"{folder}: a symbolic link that leads nowhere") from None
        raise


@contextlib.contextmanager
def atomic_path(final: Path, *, alone: bool = False, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `final`, and rename it to `final` if the block succeeds.

    The block may create a file or a folder at the temporary path. An existing file or folder at `final` is
    replaced. If the block raises (a full disk, Ctrl-C), everything written is removed and `final` is
    unchanged. What a killed process left is removed when the next one writes to the same folder. In a block
    of `together`, `final` appears at the end of that block.

    Args:
        final: path of the file or folder.
        alone: whether to refuse if another process of this machine is writing the same path. It is for what
            takes long to write. Otherwise the version that is finished last remains.
        durable: whether `final` is complete even after a power failure that follows the block. Entries of
            caches need not be: they are many, and damaged ones are computed again.

    Raises:
        InputError: the parent folder cannot be created, or another process is writing `final`.
    """
    final = Path(final)
    held_back = _held_back.get()
    with naming(final):
        # In a block of `together` the file waits in the scratch folder of that block
        if held_back is not None and final.parent.absolute() == held_back.folder:
            with held_back.written(final.name) as temporary:
                yield temporary
            return
        make_folder(final.parent)
        scratch, lock = _new_scratch(final, alone)
        temporary = scratch / final.name
        try:
            yield temporary
            if durable:
                # The content is on the disk before its final name is, and the name before the block ends
                _flush(temporary)
            _put_in_place(scratch, final)
            if durable:
                _flush_entry(final.parent)
        finally:
            _remove_scratch(scratch, lock)


@contextlib.contextmanager
def together(folder: Path) -> Iterator[None]:
    """Let the files and folders that the block writes directly into a folder appear together, at its end.

    If the block raises, none of them appears. Within the block `latest` says where such a file can be read.
    Threads and processes that are started in the block write at once.

    Raises:
        InputError: the folder cannot be created.
    """
    make_folder(folder)
    scratch, lock = _new_scratch(folder / _TOGETHER, alone=False)
    # From here `atomic_path` collects the files of this folder in the scratch folder
    held_back = _HeldBack(folder.absolute(), scratch)
    before = _held_back.set(held_back)
    try:
        yield
        # Find what cannot be put in place before anything is: all appear, or none
        for final in held_back.names:
            if (folder / final).is_dir() and not (scratch / final).is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(folder / final))
        for name in held_back.names:
            _put_in_place(scratch, folder / name)
        _flush_entry(folder)
    finally:
        _held_back.reset(before)
        _remove_scratch(scratch, lock)


def latest(final: Path) -> Path:
    """Return where the newest version of a file can be read; in a block of `together` it is not in place."""
    held_back = _held_back.get()
    if held_back is not None and final.parent.absolute() == held_back.folder:
        return held_back.scratch / final.name if final.name in held_back.names else final
    return final


def _put_in_place(scratch: Path, final: Path) -> None:
    """Move what was written from its scratch folder to its final name. A folder replaces a folder."""
    # A rename cannot replace a folder that has entries, so the old folder is moved away first.
    # If the process is killed between the two renames, `_remove_abandoned` completes the replacement
    if (scratch / final.name).is_dir() and final.is_dir():
        (scratch / _REPLACED).mkdir(exist_ok=True)
        final.rename(scratch / _REPLACED / final.name)
    os.replace(scratch / final.name, final)


@dataclass
class _HeldBack:
    """Files and folders that will appear in a folder together."""

    folder: Path
    scratch: Path
    names: list[str] = field(default_factory=list)
    """Names of those that are whole, in the order in which they were written first."""

    @contextlib.contextmanager
    def written(self, name: str) -> Iterator[Path]:
        """Yield a path for a file or folder, which is held back if the block succeeds."""
        # Written in a folder of its own, so that a failed second version leaves the first one in place
        half = Path(tempfile.mkdtemp(dir=self.scratch))
        try:
            yield half / name
            _flush(half / name)
            os.replace(half / name, self.scratch / name)
            if name not in self.names:
                self.names.append(name)
        finally:
            shutil.rmtree(half, ignore_errors=True)


# A context variable is not passed on to new threads: they write at once
_held_back: ContextVar[_HeldBack | None] = ContextVar("held_back", default=None)


@contextlib.contextmanager
def sole_writer(final: Path) -> Iterator[None]:
    """Keep other processes of this machine out of such a block for the same path.

    Unlike `atomic_path(final, alone=True)`, the block can look whether `final` is there, and leave it.

    Raises:
        InputError: another process is in such a block, or the parent folder cannot be created.
    """
    make_folder(final.parent)
    scratch, lock = _new_scratch(final.with_name(f"{final.name}{_CLAIMED}"), alone=True)
    try:
        yield
    finally:
        _remove_scratch(scratch, lock)


def writes_files() -> bool:
    """Return whether this process is writing something that is not under its final name yet."""
    return bool(_writing)


def _remove_scratch(scratch: Path, lock: int | None) -> None:
    shutil.rmtree(scratch, ignore_errors=True)
    _writing.discard(scratch)
    _unlock(lock)


def _flush(path: Path) -> None:
    """Wait until a file, or a folder with all that it holds, is on the disk and not in memory alone."""
    for folder, _, names in os.walk(path):
        for name in names:
            _flush_entry(Path(folder, name))
        _flush_entry(Path(folder))
    if path.is_file():
        _flush_entry(path)


def _flush_entry(path: Path) -> None:
    """Flush one file, or the names in one folder."""
    # O_NONBLOCK: opening a named pipe does not wait for its other end
    opened = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(opened)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # Not supported there
            raise
    finally:
        os.close(opened)


def remove_abandoned(folder: Path, *, below: bool = False) -> None:
    """Remove what killed processes of this machine left half-written in a folder.

    It looks once in the life of this process. A folder that was being replaced by another, which was whole,
    is replaced by it.

    Args:
        folder: may not exist.
        below: whether all folders in it are looked at too.
    """
    for place in _folders_below(folder) if below else (folder,):
        if place in _tidied:
            continue
        with contextlib.suppress(FileNotFoundError):
            lock = _lock(place, wait=True)
            try:
                _remove_abandoned(place)
            finally:
                _unlock(lock)


def _folders_below(folder: Path) -> Iterator[Path]:
    for parent, folders, _ in os.walk(folder):
        # Do not walk into scratch folders: they belong to their writers
        folders[:] = [name for name in folders if _SCRATCH.fullmatch(name) is None]
        yield Path(parent)


def _new_scratch(final: Path, alone: bool) -> tuple[Path, int | None]:
    """Create a scratch folder. Return it and its lock, which shows other processes that its owner lives."""
    among = None
    # The parent is locked until the new folder has its own lock. Otherwise another process could take the
    # new folder for abandoned. A scratch folder as parent is locked by this process already
    if not _SCRATCH.fullmatch(final.parent.name):
        among = _lock(final.parent, wait=True)
    try:
        _remove_abandoned(final.parent, again=alone)
        # Folders of dead processes have just been removed, so what is left has a living writer
        for _, name in _scratch_folders(final.parent) if alone else ():
            if name["final"] == final.name:
                written = str(final).removesuffix(_CLAIMED)
                raise InputError(
                    f"{written}: another process ({name['process']}) is writing it; wait for it or end it"
                )
        prefix = f".{final.name}.{_HOST}-{os.getpid()}-"
        scratch = Path(tempfile.mkdtemp(prefix=prefix, suffix=".part", dir=final.parent))
        _writing.add(scratch)
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
        except (BlockingIOError, FileNotFoundError):  # Being written, or just finished
            continue
        # A lock that can be taken has no owner. Without locks, the process number has to do
        if lock is not None or not _lives(int(name["process"])):
            for replaced in (scratch / _REPLACED).glob("*"):
                final = folder / replaced.name
                # Killed between two renames: the new folder is complete, so it takes its place
                if not final.exists():
                    os.replace(scratch / replaced.name, final)
            shutil.rmtree(scratch, ignore_errors=True)
        _unlock(lock)


def _scratch_folders(folder: Path) -> list[tuple[Path, re.Match[str]]]:
    with os.scandir(folder) as entries:
        return [(Path(entry.path), name) for entry in entries if (name := _SCRATCH.fullmatch(entry.name))]


def _lock(folder: Path, *, wait: bool = False) -> int | None:
    """Lock a folder until the returned descriptor is closed, at the latest when this process ends in any way.

    A process number is no substitute: in containers the next process often has that of the killed one.

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
    except BaseException:  # Ctrl-C during the wait
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
    except OSError:  # It belongs to another user
        pass
    return True
