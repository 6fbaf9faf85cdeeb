"""A raw log that was found, and the search for its folder."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

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
    prepare: Callable[[], object] | None = None
    """Changes modules of the parser. It runs again in each process that gets the log, before their import."""

    def __reduce__(self) -> tuple[Any, ...]:
        # Parts are unpickled in this order
        return _prepared_log, (_Preparation(self.prepare), self.source, self.log, self.map)


class _Preparation:
    """A function that is called where this is unpickled."""

    def __init__(self, prepare: Callable[[], object] | None) -> None:
        self.prepare = prepare

    def __reduce__(self) -> tuple[Any, ...]:
        return _called, (self.prepare,)


def _called(prepare: Callable[[], object] | None) -> _Preparation:
    if prepare is not None:
        prepare()
    return _Preparation(prepare)


def _prepared_log(preparation: _Preparation, source: Path, log: Any, map_parser: Any) -> RawLog:
    return RawLog(source, log, map_parser, preparation.prepare)


def folders_with(source: Path, pattern: str) -> list[Path]:
    """Return `source`, or else the folders one or two levels below it, in which `pattern` is found."""
    for depth in range(3):
        paths = sorted(source.glob("*/" * depth + pattern))
        if paths:
            return list(dict.fromkeys(item.parents[pattern.count("/")] for item in paths))
    return []
