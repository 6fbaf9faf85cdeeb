"""A raw log that was found, and the search for its folder."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from py123d.datatypes import LogMetadata
from py123d.parser.base_dataset_parser import BaseLogParser, BaseMapParser

from foredrive.data.log_paths import LogPath


@runtime_checkable
class OwnLog(Protocol):
    """A log that writes itself, by `write_log`."""

    def get_log_metadata(self) -> LogMetadata:
        """Return split and name of the log."""

    def write(self, out: Path, tick: Callable[[], None]) -> LogPath:
        """Write the log into a data root; call `tick` after each frame."""


@dataclass(frozen=True)
class RawLog:
    """One raw log with its parsers, picklable."""

    source: Path
    """Folder or file that errors name."""
    log: BaseLogParser | OwnLog
    map: BaseMapParser | None = None
    """Parser of the map, which may be shared by many logs."""


def folders_with(source: Path, pattern: str) -> list[Path]:
    """Return `source`, or else the folders one or two levels below it, in which `pattern` is found."""
    for depth in range(3):
        paths = sorted(source.glob("*/" * depth + pattern))
        if paths:
            return list(dict.fromkeys(item.parents[pattern.count("/")] for item in paths))
    return []
