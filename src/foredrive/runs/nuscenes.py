"""Export logs as a data set in nuScenes' format, several at a time. A bad log does not stop the others."""

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch

from foredrive.data import LogPath
from foredrive.engine.fan_out import fan_out, reason
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.integrations.nuscenes.dataset import NuScenesFolder, export_log, write_tables


@dataclass(frozen=True)
class ExportedLog:
    """The outcome of one log."""

    name: str
    failure: str | None = None
    """The reason in one line if it could not be exported."""
    kept: bool = False
    """True if it was exported before."""


def export_nuscenes(
    logs: Sequence[LogPath],
    folder: NuScenesFolder,
    workers: int,
    *,
    overwrite: bool = False,
    tick: Callable[[], None] = lambda: None,
) -> Iterator[ExportedLog]:
    """Yield each log when it is exported, has failed, or was exported before; then write the tables.

    The tables contain all logs of the folder, of this export and of earlier ones. Until the last log has been
    yielded, the tables of the earlier export stay in place.

    Args:
        logs: whole logs.
        folder: the data set.
        workers: number of logs exported at a time; 1 exports in this process.
        overwrite: whether logs that were exported before are exported again.
        tick: called after each frame that is written in this process.

    Raises:
        InputError: the folder has another data set or other options, another process writes it, or no log
            could be exported.
        OSError: the disk is full.
    """
    folder.begin()
    with atomic_path(folder.tables, alone=True) as tables:
        todo = []
        for log in logs:
            # The part of a log appears as a whole, when all its files and rows are written
            if not overwrite and folder.part(log).is_dir():
                yield ExportedLog(log.name, kept=True)
            else:
                todo.append(log)
        failures = []
        for log, result in _exported(todo, folder, min(workers, len(todo)), tick):
            failure = reason(log.name, result) if isinstance(result, BaseException) else None
            failures += [failure] if failure else []
            yield ExportedLog(log.name, failure)
        if not write_tables(folder, tables):
            first = f"no log could be exported; the first: {failures[0]}"
            raise InputError(failures[0] if len(failures) == 1 else first)


def _exported(
    todo: list[LogPath], folder: NuScenesFolder, workers: int, tick: Callable[[], None]
) -> Iterator[tuple[LogPath, LogPath | BaseException]]:
    if workers > 1:
        work = functools.partial(_export_here, folder=folder)
        with contextlib.closing(fan_out(todo, work, workers)) as results:
            yield from results
        return
    for log in todo:
        try:
            yield log, export_log(log, folder, tick)
        except InputError as error:
            yield log, error


def _export_here(log: LogPath, folder: NuScenesFolder) -> LogPath:
    # One thread for each worker, because the workers share the cores
    torch.set_num_threads(1)
    return export_log(log, folder)
