"""Indexing logs for search, several parts of them at once."""

import contextlib
import functools
import hashlib
import os
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch

from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.runs.fan_out import fan_out, reason
from foredrive.runs.folder import held
from foredrive.runs.search.towers import find_towers
from foredrive.search.embedding import embed_frames
from foredrive.search.index import FrameIndex, Making, Part, Scores

PART_FRAMES = 64
"""Embedded by one worker in one go: what memory holds does not grow with the length of logs."""
FLUSH_ROWS, FLUSH_S = 20_000, 60.0
"""Rows are written in large batches, but no work of more than a minute is lost when a machine stops."""
COMPACT_WRITES = 100
"""Writes before files are merged; until old versions are dropped, the disk then holds all rows twice."""


@dataclass(frozen=True)
class Job:
    """A part of a log to be embedded."""

    log: LogPath
    frames: tuple[int, ...]
    part: Part


@dataclass(frozen=True)
class Indexed:
    """What came of some logs."""

    logs: int
    """That are wholly in."""
    rows: int
    """New ones."""
    there_before: int
    """Parts of logs that were in already."""
    failed: dict[str, str]
    """Why a log, or a part of it, is not in, in one line."""
    scored: int
    """Rows that were given scores."""


def index_logs(
    logs: Sequence[LogPath],
    uri: str,
    towers: str,
    stride_s: float,
    workers: int,
    *,
    on_ray: bool = False,
    scores: Scores | None = None,
    tick: Callable[[int, int], None] = lambda done, total: None,
) -> Indexed:
    """Embed what is not in the index yet; what is in stays as it is, unless its log has changed.

    Args:
        uri: folder or place on object storage.
        towers: as `find_towers` knows them.
        stride_s: time between the moments that are indexed.
        workers: parts embedded at a time.
        scores: of frames, for rows that are in and those that come.
        tick: told how many of the moments are done.

    Raises:
        InputError: the index was made by other towers or with another stride, or another process
            writes to it; the stride is not above 0.
        OSError: the disk is full or refuses.
    """
    if stride_s <= 0:
        raise InputError(f"a stride of {stride_s:g} s: moments lie apart by more than 0 s")
    tower = find_towers(towers)
    threads = max(1, torch.get_num_threads() // workers)
    work = functools.partial(embed_part, towers=towers, threads=threads)
    here = workers == 1 and not on_ray  # a process of its own would first have to load the towers
    embed = _one_by_one if here else functools.partial(fan_out, workers=workers, on_ray=on_ray)
    with contextlib.nullcontext() if "://" in uri else held(Path(uri)):
        index = FrameIndex.make(uri, Making(tower.name, tower.fingerprint, tower.dim, stride_s))
        failed: dict[str, str] = {}
        jobs = _plan(logs, index, failed)
        there = index.parts()
        todo = [job for job in jobs if job.part not in there]
        total = sum(len(job.frames) for job in todo)
        writer, done = IndexWriter(index), 0
        tick(0, total)
        with contextlib.closing(embed(todo, work)) as results, writer:
            for job, result in results:
                if isinstance(result, BaseException):
                    why = reason(job.part.log, result)
                    failed[job.part.log] = f"frames {job.part.first} to {job.part.last}: {why}"
                else:
                    writer.add(job.part, result)
                done += len(job.frames)
                tick(done, total)
        scored = index.set_scores(scores) if scores else 0
        if writer.rows or scored:
            index.optimise()
    whole = {job.part.log for job in jobs} - failed.keys()
    return Indexed(len(whole), writer.rows, len(jobs) - len(todo), failed, scored)


def _one_by_one(
    jobs: Sequence[Job], work: Callable[[Job], pa.Table]
) -> Generator[tuple[Job, pa.Table | BaseException], None, None]:
    """As `fan_out`, in this process."""
    for job in jobs:
        try:
            result = work(job)
        except Exception as error:
            result = error
        yield job, result


class IndexWriter:
    """Puts finished parts into an index, many at a time, and compacts it now and then.

    A context: whatever waits at its end is put in, after an interruption as well.
    """

    rows: int
    """That were put in."""

    def __init__(self, index: FrameIndex) -> None:
        self.rows = 0
        self._index = index
        self._waiting: list[tuple[Part, pa.Table]] = []
        self._flushed_s = time.monotonic()
        self._since_writes = 0

    def __enter__(self) -> "IndexWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None or kind is KeyboardInterrupt:
            self.flush()

    def add(self, part: Part, rows: pa.Table) -> None:
        """Put a part in, now or with those that follow."""
        self._waiting.append((part, rows))
        waiting = sum(len(rows) for _, rows in self._waiting)
        if waiting >= FLUSH_ROWS or time.monotonic() - self._flushed_s > FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Put in whatever still waits."""
        if self._waiting:
            self._index.add(self._waiting)
            self.rows += sum(len(rows) for _, rows in self._waiting)
            self._since_writes += 1
            self._waiting = []
        if self._since_writes >= COMPACT_WRITES:
            self._index.compact()
            self._since_writes = 0
        self._flushed_s = time.monotonic()


def embed_part(job: Job, towers: str, threads: int | None = None) -> pa.Table:
    """The rows of a part."""
    if threads is not None:
        torch.set_num_threads(threads)
    return embed_frames(_opened(job.log), job.frames, find_towers(towers))


@functools.lru_cache(maxsize=2)
def _opened(path: LogPath) -> Log:
    return Log(path)


def _plan(logs: Sequence[LogPath], index: FrameIndex, failed: dict[str, str]) -> list[Job]:
    """Every part of every log that can be opened; logs that have changed are taken out of the index."""
    jobs, folder_of = [], dict[str, Path]()
    digests = {part.log: part.digest for part in index.parts()}
    for path in logs:
        if folder_of.setdefault(path.name, path.folder) != path.folder:
            failed[path.name] = f"{path.folder} has the name of {folder_of[path.name]}"
            continue
        try:
            frames, digest = moments(Log(path), index.making.stride_s), log_digest(path)
        except InputError as error:
            failed[path.name] = str(error)
            continue
        if digests.get(path.name, digest) != digest:
            index.drop(path.name)
        for start in range(0, len(frames), PART_FRAMES):
            chosen = tuple(frames[start : start + PART_FRAMES])
            jobs.append(Job(path, chosen, Part(path.name, chosen[0], chosen[-1], digest)))
    return jobs


def moments(log: Log, stride_s: float) -> list[int]:
    """The frames nearest to every so many seconds of a log, in its parts if only those are meant."""
    frame, found = log.nearest_frames(np.arange(log.t_us[0], log.t_us[-1] + 1, stride_s * 1e6))
    frames = np.unique(frame[found])
    if log.path.parts_s:
        t_s = (log.t_us[frames] - log.t_us[0]) * 1e-6
        frames = frames[np.any([(t_s >= start) & (t_s < end) for start, end in log.path.parts_s], axis=0)]
    return [int(frame) for frame in frames]


def log_digest(path: LogPath) -> str:
    """Changes when a log's files do: their names, sizes and times of change."""
    digest = hashlib.sha256()
    for entry in sorted(os.scandir(path.folder), key=lambda entry: entry.name):
        facts = entry.stat()
        digest.update(f"{entry.name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]
