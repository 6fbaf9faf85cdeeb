"""Locations of 123D logs. This module has no heavy imports, so that a wrong path is reported at once."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.data.clip_list import read_clip_list
from foredrive.errors import InputError

_SEARCH_DEPTH = 3
_URL = re.compile(r"[a-z][a-z0-9+.-]+:/{1,2}[^/]")
"""The beginning of a URL, such as s3://bucket/logs. pathlib reduces its two slashes to one."""


@dataclass(frozen=True)
class LogPath:
    """Location of a log, and the folder of its maps (which may not exist)."""

    folder: Path
    maps_dir: Path
    parts_s: tuple[tuple[float, float], ...] = ()
    """Selected parts as (start, end) in s since the log's start, end exclusive. Empty means the whole log."""

    @property
    def name(self) -> str:
        """Return split/name, which is unique within a data root."""
        return f"{self.folder.parent.name}/{self.folder.name}"

    def absolute(self) -> "LogPath":
        """Return the same location, independent of the working directory."""
        return LogPath(self.folder.absolute(), self.maps_dir.absolute(), self.parts_s)

    def overlaps(self, other: "LogPath") -> bool:
        """Return whether both are of one log, by its name, and have a time in common."""
        if self.name != other.name:
            return False
        common = (
            max(start, other_start) < min(end, other_end)
            for start, end in self.parts_s
            for other_start, other_end in other.parts_s
        )
        return not self.parts_s or not other.parts_s or any(common)


def find_logs(path: Path) -> list[LogPath]:
    """Find all 123D logs at `path`.

    The path is a data root (with logs/SPLIT/NAME), the folder of a split or of one log, or a clip list
    (`clip_list`). A clip list gives its logs with the listed parts. Folders may be in object storage, as
    s3://BUCKET/PATH: their logs are fetched when they are opened (`log_mirror`).

    Raises:
        InputError: there is no log, or object storage cannot be read.
    """
    if _URL.match(str(path)):
        from foredrive.data.log_mirror import mirrored_logs  # Imports pyarrow, which is slow

        folders = mirrored_logs(path, _SEARCH_DEPTH)
        return _found(folders, str(path))
    path = Path(path).absolute()
    if path.is_file():
        return _listed_logs(path)
    if not path.is_dir():
        raise InputError(f"{path}: no such folder")
    return _found(sorted(_log_folders(path, _SEARCH_DEPTH)), str(path))


def _found(folders: list[Path], where: str) -> list[LogPath]:
    if not folders:
        raise InputError(f"{where}: no 123D log here (a log is a folder with a sync.arrow)")
    # A data root has logs/SPLIT/NAME and maps
    return [LogPath(folder, folder.parents[2] / "maps") for folder in folders]


def find_all_logs(paths: Sequence[Path]) -> tuple[LogPath, ...]:
    """Return the logs at several paths, without duplicates."""
    return tuple({log.folder: log for path in paths for log in find_logs(path)}.values())


def find_one_log(path: Path) -> LogPath:
    """Return the only log at `path`.

    Raises:
        InputError: there is none, or there are several.
    """
    logs = find_logs(path)
    if len(logs) > 1:
        raise InputError(f"{path}: holds {len(logs)} logs; name one, such as {logs[0].folder}")
    return logs[0]


def _listed_logs(path: Path) -> list[LogPath]:
    parts: dict[tuple[Path, Path], list[tuple[float, float]]] = {}
    for clip in read_clip_list(path):
        parts.setdefault((clip.folder, clip.maps_dir), []).append((clip.start_s, clip.end_s))
    for folder, _ in parts:
        if not (folder / "sync.arrow").is_file() and not _is_mirrored(folder):
            raise InputError(f"{path}: the log {folder} does not exist")
    return [LogPath(folder, maps_dir, _united(spans)) for (folder, maps_dir), spans in parts.items()]


def _is_mirrored(folder: Path) -> bool:
    from foredrive.data.log_mirror import is_mirrored  # Imports pyarrow, which is slow

    return is_mirrored(folder)


def _united(spans: list[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Sort spans by time and merge those that touch."""
    out: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        if out and start <= out[-1][1]:
            out[-1] = (out[-1][0], max(out[-1][1], end))
        else:
            out.append((start, end))
    return tuple(out)


def _log_folders(path: Path, depth: int) -> Iterator[Path]:
    if (path / "sync.arrow").is_file():
        yield path
    elif depth > 0:
        for below in path.iterdir():
            if below.is_dir() and not below.name.startswith("."):
                yield from _log_folders(below, depth - 1)
