"""A data set in nuScenes' format, which grows log by log.

The rows of each log are kept beside the tables, in a folder of their own below `.v1.0-NAME`. It is written
when all files of the log are there, so an export that was stopped goes on with the next log. The tables are
put together from these folders.
"""

import dataclasses
import json
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.files import atomic_path, remove_abandoned
from foredrive.integrations.nuscenes.scene import SceneOptions, write_scene
from foredrive.integrations.nuscenes.tables import TABLES_OF_A_LOG, Row, shared_tables

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_OPTIONS = "options.json"


@dataclass(frozen=True)
class NuScenesFolder:
    """A data set in nuScenes' format: its root, its name, and what of each log it has."""

    root: Path
    name: str
    options: SceneOptions

    @property
    def tables(self) -> Path:
        """Return the folder of the tables, such as v1.0-mini."""
        return self.root / f"v1.0-{self.name}"

    @property
    def parts(self) -> Path:
        """Return the folder of the rows of single logs."""
        return self.root / f".v1.0-{self.name}"

    def part(self, log: LogPath) -> Path:
        """Return the folder of the rows of a log."""
        return self.parts / log.name

    def begin(self) -> None:
        """Check that logs may be added, and note the options.

        Raises:
            InputError: the name cannot be one, the tables are those of another data set, or the data set was
                begun with other options.
        """
        if not _NAME.fullmatch(self.name):
            raise InputError(f"--name {self.name!r}: letters, digits, '.', '_' and '-' only")
        noted, options = self.parts / _OPTIONS, dataclasses.asdict(self.options)
        if not noted.is_file():
            if self.tables.exists():
                raise InputError(f"{self.tables}: there is another data set already; choose another --name")
            with atomic_path(noted) as file:
                file.write_text(json.dumps(options))
        elif (before := json.loads(noted.read_text())) != options:
            begun = f"was begun with {_option_list(before)}, not {_option_list(options)}"
            raise InputError(f"{self.tables}: {begun}; choose another --name")
        remove_abandoned(self.parts, below=True)


def export_log(path: LogPath, folder: NuScenesFolder, tick: Callable[[], None] = lambda: None) -> LogPath:
    """Write the files and rows of one log. The tables do not have it yet.

    Args:
        path: the log.
        folder: the data set.
        tick: called after each frame.

    Raises:
        InputError: the log cannot be read, or it has no sensors.
    """
    with atomic_path(folder.part(path)) as part:
        tables = write_scene(Log(path), folder.root, folder.options, tick)
        part.mkdir()
        for name in TABLES_OF_A_LOG:
            _write_table(part / f"{name}.json", tables[name])
    return path


def write_tables(folder: NuScenesFolder, out: Path) -> int:
    """Write the tables of all logs that were exported, in the order of their names, and `splits.json`.

    Args:
        folder: the data set.
        out: the folder to write into, which is made.

    Returns:
        The number of scenes.
    """
    out.mkdir()
    parts = sorted(file.parent for file in folder.parts.glob("*/*/scene.json"))
    for name, shared in shared_tables().items():
        _write_table(out / f"{name}.json", shared)
    for name in TABLES_OF_A_LOG:
        rows = (row for part in parts for row in _read_table(part, name))
        _write_table(out / f"{name}.json", _shared_maps(rows) if name == "map" else _distinct(rows))
    splits: dict[str, list[str]] = {}
    for part in parts:
        splits.setdefault(part.parent.name, []).extend(row["name"] for row in _read_table(part, "scene"))
    (out / "splits.json").write_text(json.dumps(splits, indent=1))
    return len(parts)


def _shared_maps(rows: Iterable[Row]) -> Iterable[Row]:
    """Return the rows of maps, each with all logs that share it."""
    maps: dict[str, Row] = {}
    for row in rows:
        shared = maps.setdefault(row["token"], row | {"log_tokens": []})
        shared["log_tokens"] += row["log_tokens"]
    return maps.values()


def _distinct(rows: Iterable[Row]) -> Iterator[Row]:
    """Yield rows without those whose token has been before: logs share sensors."""
    seen = set()
    for row in rows:
        if row["token"] not in seen:
            seen.add(row["token"])
            yield row


def _read_table(part: Path, name: str) -> list[Row]:
    rows: list[Row] = json.loads((part / f"{name}.json").read_text())
    return rows


def _write_table(file: Path, rows: Iterable[Row]) -> None:
    """Write a table, a row in a line."""
    with file.open("w") as opened:
        before = "[\n"
        for row in rows:
            opened.write(before + json.dumps(row, allow_nan=False))
            before = ",\n"
        opened.write("\n]\n" if before != "[\n" else "[]\n")


def _option_list(options: dict[str, object]) -> str:
    return f"--rate {options['rate_hz']:g}{'' if options['sweeps'] else ' --no-sweeps'}"
