"""Logs in object storage, mirrored into a local folder of bounded size.

s3://BUCKET/PATH is mirrored as FOLDER/s3/BUCKET/PATH, so that the local path of a log states its origin in
every file that contains the path. A log is fetched as a whole when it is opened, and stays as long as a
process has it open. When there is no room for another log, the least recently used logs that no process has
open are removed.

Several processes share the mirror. Each file under FOLDER/.locks is the lock of one log or of one folder of
maps: shared while it is open, exclusive while it is fetched or removed. The operating system releases the
locks of a killed process. Tried with a server of S3's interface, never with a public bucket
(`docs/how-to/other-tools.md`).
"""

import contextlib
import fcntl
import functools
import hashlib
import itertools
import json
import os
import random
import shutil
import time
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import pyarrow as pa
from filelock import FileLock
from pyarrow import fs

from foredrive.data.arrow_files import REFUSES_WRITING
from foredrive.errors import InputError
from foredrive.files import atomic_path, make_folder

FOLDER_VARIABLE, SIZE_VARIABLE = "FOREDRIVE_LOGS", "FOREDRIVE_LOGS_GB"
DEFAULT_GB = 100.0
PATIENCE = 20
"""Number of attempts to lock a log whose files have changed."""
AT_A_TIME, CHUNK = 8, 2**22
"""Number of files fetched at the same time, and number of bytes read at once."""
_CREDENTIALS = ("ACCESS_DENIED", "NO_CREDENTIALS", "INVALID_ACCESS_KEY", "SIGNATURE", "redential")

Listing = tuple[tuple[str, int, int], ...]
"""Name, size in bytes and time of modification in ns of each file, in the order of the names."""


class Hold:
    """A log that stays in the mirror as long as this object lives."""

    def __init__(self, lock: int) -> None:
        # Closing the descriptor releases the lock
        weakref.finalize(self, os.close, lock)


@dataclass(frozen=True)
class _Entry:
    """A log or a folder of maps in the mirror."""

    folder: Path

    @property
    def url(self) -> str:
        scheme, *parts = self.folder.relative_to(mirror_folder()).parts
        return f"{scheme}://{'/'.join(parts)}"

    def note(self, kind: str) -> Path:
        """Return the path of a file about this entry."""
        digest = hashlib.blake2b(self.url.encode(), digest_size=16).hexdigest()
        return mirror_folder() / f".{kind}" / digest

    def listing(self) -> Listing:
        """Return the files in object storage, as they were when they were listed last."""
        try:
            written = json.loads(self.note("listings").read_text())
            return tuple((str(name), int(size), int(t_ns)) for name, size, t_ns in written)
        except (OSError, ValueError, TypeError):
            listing = _listings(self.url, allow_missing=True).get(self.folder, ())
            self.write_listing(listing)
            return listing

    def write_listing(self, listing: Listing) -> None:
        file, text = self.note("listings"), json.dumps(listing)
        if not (file.is_file() and file.read_text() == text):
            with atomic_path(file) as temporary:
                temporary.write_text(text)

    def is_whole(self, listing: Listing) -> bool:
        try:
            stats = [(self.folder / name).stat() for name, _, _ in listing]
        except OSError:
            return False
        return all(
            (facts.st_size, facts.st_mtime_ns) == (size, t_ns)
            for facts, (_, size, t_ns) in zip(stats, listing, strict=True)
        )


def mirror_folder() -> Path:
    """Return the folder of the mirror."""
    return Path(os.environ.get(FOLDER_VARIABLE) or Path.home() / ".cache" / "foredrive" / "logs").absolute()


def is_mirrored(folder: Path) -> bool:
    """Return whether a local path belongs to the mirror; it may have to be fetched."""
    root = mirror_folder()
    return folder.is_relative_to(root) and len(folder.relative_to(root).parts) > 1


def mirrored_logs(path: Path, depth: int) -> list[Path]:
    """Return the local folders of all logs at a URL, down to a depth of folders. Nothing is fetched yet.

    Raises:
        InputError: there is no such place, or it cannot be listed.
    """
    scheme, rest = str(path).split(":", 1)
    url = f"{scheme}://{rest.strip('/')}"
    if any(sign in url for sign in "@?#") or ".." in PurePosixPath(rest).parts:
        raise InputError(f"{url}: only a bucket and a folder; credentials and options are in the environment")
    base, paths = mirror_folder() / scheme / rest.strip("/"), []
    for folder, listing in sorted(_listings(url).items()):
        inside = folder.relative_to(base).parts
        hidden = any(part.startswith(".") for part in inside)
        if any(name == "sync.arrow" for name, _, _ in listing) and len(inside) <= depth and not hidden:
            _Entry(folder).write_listing(listing)
            paths.append(folder)
    return paths


def hold(folder: Path) -> Hold | None:
    """Keep a log or a folder of maps in the mirror, and fetch it if needed. None: it is not mirrored.

    Raises:
        InputError: it cannot be fetched, or there is no room for it.
        OSError: the disk is full.
    """
    if not is_mirrored(folder):
        return None
    entry = _Entry(folder)
    listing = entry.listing()
    lock = _open_lock(entry)
    held = Hold(lock)
    for attempt in itertools.count():
        fcntl.flock(lock, fcntl.LOCK_SH)  # Waits while another process fetches it
        if entry.is_whole(listing):
            # The time of the lock file is the time of last use, by which `_make_room` orders the entries
            os.utime(lock)
            return held
        # The files in storage have changed while another process keeps the old ones open
        if attempt > PATIENCE and entry.folder.is_dir():
            raise InputError(
                f"{entry.url}: has changed, and another process reads its former files from {entry.folder}"
            )
        # Release the shared lock first: two processes that keep theirs could never get the exclusive one
        fcntl.flock(lock, fcntl.LOCK_UN)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:  # Another process fetches it, or is about to
            time.sleep(random.uniform(0.01, 0.1))
            continue
        if not entry.is_whole(listing):
            _fetch(entry, listing)
    raise AssertionError("the loop above has no end")


def _fetch(entry: _Entry, listing: Listing) -> None:
    """Fetch the files of an entry. The caller holds its exclusive lock."""
    record, size = entry.note("entries"), sum(size for _, size, _ in listing)
    make_folder(record.parent)
    with FileLock(mirror_folder() / ".room"):
        # Room is reserved under a lock by the record of the entry, before anything is fetched
        record.unlink(missing_ok=True)
        _make_room(entry, size)
        with atomic_path(record) as temporary:
            temporary.write_text(json.dumps({"folder": str(entry.folder), "bytes": size}))
    try:
        with atomic_path(entry.folder) as temporary, ThreadPoolExecutor(AT_A_TIME) as threads:
            temporary.mkdir()
            copy = functools.partial(_copy, entry, temporary)
            for _ in threads.map(copy, listing):
                pass
    except BaseException:
        # Give the reserved room back, unless an older version is still in place
        if not entry.folder.is_dir():
            record.unlink(missing_ok=True)
        raise


def _copy(entry: _Entry, folder: Path, file: tuple[str, int, int]) -> None:
    name, size, t_ns = file
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    url = f"{entry.url}/{name}"
    with _download_errors(url):
        storage, place = _storage(url)
        with storage.open_input_stream(place) as source, path.open("wb") as target:
            shutil.copyfileobj(source, target, CHUNK)
    if path.stat().st_size != size:
        # The stored listing is out of date, so the next attempt lists the files again
        entry.note("listings").unlink(missing_ok=True)
        raise InputError(f"{url}: has {path.stat().st_size} bytes, not {size}: it has changed; start again")
    # `is_whole` compares sizes and times with the listing
    os.utime(path, ns=(t_ns, t_ns))


def _make_room(entry: _Entry, size: int) -> None:
    """Remove the least recently used entries that no process has open until `size` bytes fit.

    Raises:
        InputError: there is no room.
    """
    limit = _limit_bytes()
    space = f"the {limit / 1e9:g} GB of {mirror_folder()} (set {SIZE_VARIABLE})"
    if size > limit:
        raise InputError(f"{entry.url}: {size / 1e9:.3g} GB do not fit into {space}")
    entries = []
    for record in entry.note("entries").parent.iterdir():
        if not record.name.startswith("."):
            noted = json.loads(record.read_text())
            other = _Entry(Path(noted["folder"]))
            entries.append((other.note("locks").stat().st_mtime_ns, other, int(noted["bytes"])))
    used = sum(held for _, _, held in entries)
    for _, other, held in sorted(entries, key=lambda one: one[0]):
        if used + size <= limit:
            return
        lock = _open_lock(other)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:  # Some process has it open
            continue
        else:
            shutil.rmtree(other.folder, ignore_errors=True)
            other.note("entries").unlink()
            used -= held
        finally:
            os.close(lock)
    if used + size > limit:
        raise InputError(
            f"{entry.url}: {size / 1e9:.3g} GB do not fit beside the {used / 1e9:.3g} GB in use into {space}"
        )


def _limit_bytes() -> float:
    setting = os.environ.get(SIZE_VARIABLE) or str(DEFAULT_GB)
    with contextlib.suppress(ValueError):
        if float(setting) > 0:
            return float(setting) * 1e9
    raise InputError(f"{SIZE_VARIABLE} must be a number above 0, got {setting!r}")


def _open_lock(entry: _Entry) -> int:
    lock = entry.note("locks")
    make_folder(lock.parent)
    return os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)


def _listings(url: str, *, allow_missing: bool = False) -> dict[Path, Listing]:
    """Return the files of all folders at a URL, by their local folders. A folder of maps is one entry."""
    scheme = url.split("://")[0]
    with _download_errors(url):
        storage, place = _storage(url)
        selector = fs.FileSelector(place, recursive=True, allow_not_found=allow_missing)
        file_infos = [info for info in storage.get_file_info(selector) if info.type == fs.FileType.File]
    base = mirror_folder() / scheme
    listings: dict[Path, list[tuple[str, int, int]]] = {}
    for info in file_infos:
        path = PurePosixPath(info.path)
        if ".." in path.parts:
            raise InputError(f"{url}: the name {info.path!r} leaves its folder")
        folder = PurePosixPath(place) if PurePosixPath(place).name == "maps" else path.parent
        listings.setdefault(base / folder, []).append(
            (str(path.relative_to(folder)), info.size, info.mtime_ns or 0)
        )
    return {folder: tuple(sorted(files)) for folder, files in listings.items()}


def _storage(url: str) -> tuple[fs.FileSystem, str]:
    """Return the file system of a URL and the path in it."""
    scheme, place = url.split("://")
    bucket = place.split("/")[0]
    return _file_system(f"{scheme}://{bucket}"), place


@functools.lru_cache(maxsize=16)
def _file_system(bucket: str) -> fs.FileSystem:
    return fs.FileSystem.from_uri(bucket)[0]


@contextlib.contextmanager
def _download_errors(url: str) -> Iterator[None]:
    """Convert errors of object storage to `InputError`s of one line."""
    try:
        yield
    except FileNotFoundError:
        raise InputError(f"{url}: no such bucket or folder") from None
    except (OSError, pa.ArrowException) as error:
        if isinstance(error, OSError) and error.errno in REFUSES_WRITING:
            raise
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if "NO_SUCH_BUCKET" in reason:
            raise InputError(f"{url}: no such bucket or folder") from None
        hint = "; are the credentials set (AWS_ACCESS_KEY_ID, AWS_PROFILE, …)?"
        raise InputError(
            f"{url}: {reason}{hint if any(word in reason for word in _CREDENTIALS) else ''}"
        ) from error
