"""A raw log that was found, and the search for its folder."""

from dataclasses import dataclass
from pathlib import Path

from py123d.parser.base_dataset_parser import BaseLogParser, BaseMapParser


@dataclass(frozen=True)
class RawLog:
    """One raw log with its parsers, picklable."""

    source: Path
    """Folder or file that errors name."""
    log: BaseLogParser
    map: BaseMapParser | None = None
    """Parser of the map, which may be shared by many logs."""


def folders_with(source: Path, pattern: str) -> list[Path]:
    """Return `source`, or else the folders one or two levels below it, in which `pattern` is found."""
    for depth in range(3):
        found = sorted(source.glob("*/" * depth + pattern))
        if found:
            return list(dict.fromkeys(item.parents[pattern.count("/")] for item in found))
    return []
