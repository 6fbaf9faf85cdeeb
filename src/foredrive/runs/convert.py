"""Convert the logs of a data set, several at a time.

Finished logs are kept. A bad log does not stop the others.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from foredrive.data.arrow_files import check_whole
from foredrive.data.formats.convert import convert_log, find_raw_logs, log_path
from foredrive.data.formats.guard import reading_raw
from foredrive.data.formats.raw_log import RawLog
from foredrive.data.log_paths import LogPath
from foredrive.engine.fan_out import fan_out, reason
from foredrive.errors import InputError
from foredrive.files import remove_abandoned, sole_writer


@dataclass(frozen=True)
class Conversion:
    """The outcome of one raw log."""

    name: str
    """Its split and name."""
    log: LogPath | None
    """Its log, or None if it has none."""
    failure: str | None = None
    """The reason in one line if it has no log."""
    kept: bool = False
    """Whether its log was there before."""


def convert_all(
    source: Path,
    dataset: str,
    out: Path,
    workers: int,
    *,
    overwrite: bool = False,
    topics: Path | None = None,
    on_ray: bool = False,
    tick: Callable[[], None] = lambda: None,
) -> Iterator[Conversion]:
    """Yield each raw log when it has been converted, has failed, or was there before.

    Args:
        source: folder of one raw log, or of many.
        dataset: one of `DATASETS`.
        out: 123D data root.
        workers: number of logs converted at a time; 1 converts in this process.
        overwrite: whether logs that are there are replaced.
        topics: the YAML of a bag; None: that beside it.
        on_ray: whether the logs are converted on a Ray cluster; see `fan_out`.
        tick: called after each frame that is converted in this process.

    Raises:
        InputError: the data set is unknown, or there is no log of it.
        OSError: the disk is full, so that no other log could be written.
    """
    todo, paths, sources = [], dict[int, LogPath](), dict[Path, Path]()
    for raw in find_raw_logs(source, dataset, topics):
        with reading_raw(raw.source):
            path = log_path(raw.log.get_log_metadata(), out)
        remove_abandoned(path.folder.parent)  # Also where no log has to be converted
        # A second log of one name would take the first for its own, and be lost
        if path.folder in sources:
            clash = f"a second log of this name, in {raw.source}; the first is in {sources[path.folder]}"
            yield Conversion(path.name, None, f"{path.name}: {clash}")
            continue
        sources[path.folder] = raw.source
        if not overwrite and _is_whole(path.folder):
            yield Conversion(path.name, path, kept=True)
        else:
            paths[id(raw)] = path
            todo.append(raw)
    for raw, result in _converted(todo, out, workers, on_ray, overwrite, tick):
        path = paths[id(raw)]
        if isinstance(result, BaseException):
            yield Conversion(path.name, None, reason(path.name, result))
        else:
            yield Conversion(path.name, path, kept=result is None)


def _converted(
    todo: list[RawLog], out: Path, workers: int, on_ray: bool, overwrite: bool, tick: Callable[[], None]
) -> Iterator[tuple[RawLog, LogPath | BaseException | None]]:
    if (workers > 1 and len(todo) > 1) or on_ray:
        work = functools.partial(_convert_here, out=out, overwrite=overwrite)
        with contextlib.closing(fan_out(todo, work, workers, on_ray=on_ray)) as results:
            yield from results
        return
    for raw in todo:
        try:
            yield raw, _convert_unless_there(raw, out, overwrite, tick)
        except InputError as error:
            yield raw, error


def _convert_here(raw: RawLog, out: Path, overwrite: bool) -> LogPath | None:
    # One thread for each worker, because the workers share the cores
    torch.set_num_threads(1)
    return _convert_unless_there(raw, out, overwrite)


def _convert_unless_there(
    raw: RawLog, out: Path, overwrite: bool, tick: Callable[[], None] = lambda: None
) -> LogPath | None:
    """Convert a log; return None if another process has done it since this one began.

    Raises:
        InputError: as `convert_log`, or another process is converting the log.
    """
    with reading_raw(raw.source):
        path = log_path(raw.log.get_log_metadata(), out)
    # Look again with the path claimed: another process may have finished the log in the meantime
    with sole_writer(path.folder):
        return None if not overwrite and _is_whole(path.folder) else convert_log(raw, out, tick)


def _is_whole(folder: Path) -> bool:
    if not (folder / "sync.arrow").is_file():
        return False
    try:
        check_whole(folder)
    except InputError:
        return False
    return True
