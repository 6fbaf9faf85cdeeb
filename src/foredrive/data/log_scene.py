"""py123d's reader of one log, for any number of logs at a time."""

import functools
import logging
import os
import resource
from pathlib import Path
from typing import Any

from py123d.api.scene.arrow.arrow_scene_api import ArrowSceneAPI
from py123d.api.utils.arrow_metadata_utils import (
    LogDirectoryMetadata,
    get_metadata_from_arrow_schema,
    resolve_metadata_class,
)
from py123d.datatypes import LogMetadata

from foredrive.data.arrow_files import arrow_schema, reading

_NO_MODALITY = ("sync.arrow", "map.arrow")
MAX_OPEN_TABLES = 1000
"""Maximum number of Arrow files that a process keeps open. py123d's own limit is 5,000: more than many
systems allow."""
_class_of = functools.cache(resolve_metadata_class)
_log = logging.getLogger(__name__)
_may_open = min(MAX_OPEN_TABLES, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
os.environ.setdefault("PY123D_MAX_LRU_CACHED_TABLES", str(_may_open))  # read by py123d when it opens a table


class LogScene(ArrowSceneAPI):
    """A log whose metadata are read once and are part of its pickle.

    py123d keeps the metadata of the last 1,000 logs in each process. Clips of more logs in random order would
    open all files of a log for each clip. py123d also skips files that are damaged.

    Args:
        metadata: of all files; None reads them.

    Raises:
        InputError: a file is not whole, or the log's metadata cannot be read.
    """

    __slots__ = ("_metadata",)

    def __init__(self, folder: Path, maps_dir: Path, metadata: LogDirectoryMetadata | None = None) -> None:
        super().__init__(folder, maps_root=maps_dir)
        self._metadata = _read_metadata(folder) if metadata is None else metadata

    def __reduce__(self) -> tuple[Any, ...]:
        return LogScene, (self._log_dir, self._maps_root, self._metadata)

    def _get_log_dir_metadatas(self) -> LogDirectoryMetadata:
        return self._metadata


def _read_metadata(folder: Path) -> LogDirectoryMetadata:
    schemas = {file: arrow_schema(file) for file in [folder / "sync.arrow", *sorted(folder.glob("*.arrow"))]}
    with reading(folder, "its metadata"):
        found = LogDirectoryMetadata(
            get_metadata_from_arrow_schema(schemas[folder / "sync.arrow"], LogMetadata)
        )
        for file, schema in schemas.items():
            if file.name not in _NO_MODALITY:
                try:
                    metadata = get_metadata_from_arrow_schema(schema, _class_of(file.stem))
                except (ValueError, KeyError) as error:
                    _log.warning("%s is left out: %s", file, error)
                    continue
                found.modality_metadatas[file.stem] = metadata
    return found
