"""A disk cache with one file for each entry, named by everything that the entry depends on."""

import hashlib
import logging
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from foredrive.data.logs import Log
from foredrive.data.maps import map_file
from foredrive.files import atomic_path

_CHECKSUM_BYTES = 4
_log = logging.getLogger(__name__)
T = TypeVar("T")


def entry_file(folder: Path, key: object, suffix: str) -> Path:
    """Return the file of an entry. Its name is a hash of the key's `repr`, so a stale entry is never read."""
    name = hashlib.blake2b(repr(key).encode(), digest_size=16).hexdigest()
    return folder / name[:2] / f"{name}.{suffix}"


def map_fingerprint(log: Log) -> tuple[str, int, int] | None:
    """Return what tells whether a log's map has changed: its file, size and modification time."""
    file = map_file(log)
    return None if file is None else (str(file), file.stat().st_size, file.stat().st_mtime_ns)


class DiskCache:
    """Entries of one kind. They are written atomically, and damaged ones are made again.

    Args:
        folder: folder of the entries. None: every entry is made when it is asked for.
        suffix: suffix of the files.
    """

    def __init__(self, folder: Path | None, suffix: str) -> None:
        self._folder, self._suffix = folder, suffix

    def get(
        self,
        key: object,
        make: Callable[[], T],
        encode: Callable[[T], bytes],
        decode: Callable[[bytes], T],
    ) -> T:
        """Return an entry, from the disk or made.

        Args:
            key: everything that the entry depends on, with a readable and complete `repr`.
            make: makes the entry.
            encode, decode: the entry as bytes, and back. What was made is returned as it is read later, with
                the rounding of the encoding.

        Raises:
            OSError: the disk is full.
        """
        if self._folder is None:
            return make()
        file = entry_file(self._folder, key, self._suffix)
        try:
            return decode(_checked(file.read_bytes()))
        except FileNotFoundError:
            _log.debug("%s is made", file)
        except Exception as error:  # any damaged entry can be made again
            _log.warning("%s is damaged (%s) and is made anew", file, error)
        body = encode(make())
        with atomic_path(file, durable=False) as temporary:
            temporary.write_bytes(zlib.crc32(body).to_bytes(_CHECKSUM_BYTES, "little") + body)
        return decode(body)


def _checked(data: bytes) -> bytes:
    """Return an entry's bytes without the checksum in front, which finds entries that were cut off."""
    body = data[_CHECKSUM_BYTES:]
    if zlib.crc32(body).to_bytes(_CHECKSUM_BYTES, "little") != data[:_CHECKSUM_BYTES]:
        raise ValueError("checksum")
    return body
