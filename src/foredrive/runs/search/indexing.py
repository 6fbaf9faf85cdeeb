"""Index logs for search, several parts at a time."""

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
from foredrive.engine.fan_out import fan_out, reason
from foredrive.engine.folder import held
from foredrive.errors import InputError
from foredrive.runs.search.towers import find_towers
from foredrive.search.embedding import embed_frames
from foredrive.search.index import FrameIndex, IndexSettings, Part, Scores

PART_FRAMES = 64
"""Frames that one worker embeds at a time. The limit keeps the memory independent of the length of a log."""
FLUSH_ROWS, FLUSH_S = 20_000, 60.0
"""Rows are written in large batches, but at least once a minute, so that a crash loses at most that."""
COMPACT_WRITES = 100
"""Number of writes before files are merged. Until old versions are dropped, the disk holds all rows twice."""


@dataclass(frozen=True)
class Job:
    """A part of a log to embed."""

    log: LogPath
    frames: tuple[int, ...]
    part: Part


@dataclass(frozen=True)
class Indexed:
    """The result of indexing logs."""

    logs: int
    """Number of logs that are completely indexed."""
    rows: int
    """Number of new rows."""
    there_before: int
    """Number of parts that were in the index before."""
    failed: dict[str, str]
    """The reason in one line for each log that is not completely in the index."""
    scored: int
    """Number of rows that received scores."""


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
    """Embed the parts that are not in the index yet. Indexed parts stay, unless their log has changed.

    Args:
        uri: folder, or location in object storage.
        towers: name as for `find_towers`.
        stride_s: time between the indexed moments, s.
        workers: number of parts embedded at a time.
        scores: scores of frames, for rows in the index and for new rows.
        tick: called with the number of finished moments and of all moments.

    Raises:
        InputError: the index was made by other towers or with another stride, or another process writes to
            it; the stride is not above 0.
        OSError: the disk is full or cannot be written.
    """
    if stride_s <= 0:
        raise InputError(f"the stride must be above 0 s, not {stride_s:g} s")
    tower = find_towers(towers)
    threads = max(1, torch.get_num_threads() // workers)
    work = functools.partial(embed_part, towers=towers, threads=threads)
    here = workers == 1 and not on_ray  # a separate process would have to load the towers first
    embed = _one_by_one if here else functools.partial(fan_out, workers=workers, on_ray=on_ray)
    with contextlib.nullcontext() if "://" in uri else held(Path(uri)):
        index = FrameIndex.make(uri, IndexSettings(tower.name, tower.fingerprint, tower.dim, stride_s))
        failed: dict[str, str] = {}
        jobs = _plan([log.absolute() for log in logs], index, failed)
        indexed = index.parts()
        todo = [job for job in jobs if job.part not in indexed]
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
    """Run the jobs one after another in this process; the results have the form of `fan_out`."""
    for job in jobs:
        try:
            result = work(job)
        except Exception as error:
            result = error
        yield job, result


class IndexWriter:
    """Writes finished parts to an index in batches, and compacts the index regularly.

    It is a context manager: at its end, also after an interruption, it writes the parts that still wait.
    """

    rows: int
    """Number of rows written."""

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
        """Add a part; it is written now or with a later batch."""
        self._waiting.append((part, rows))
        waiting = sum(len(rows) for _, rows in self._waiting)
        if waiting >= FLUSH_ROWS or time.monotonic() - self._flushed_s > FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Write all parts that still wait."""
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
    """Embed the frames of a part; return its rows."""
    if threads is not None:
        torch.set_num_threads(threads)
    return embed_frames(opened_log(job.log), job.frames, find_towers(towers))


@functools.lru_cache(maxsize=2)
def opened_log(path: LogPath) -> Log:
    """Open a log, and keep it open for the next call."""
    return Log(path)


def _plan(logs: Sequence[LogPath], index: FrameIndex, failed: dict[str, str]) -> list[Job]:
    """Return all parts of the logs that can be opened; drop changed logs from the index."""
    jobs, folder_of = [], dict[str, Path]()
    digests = {part.log: part.digest for part in index.parts()}
    for path in logs:
        if folder_of.setdefault(path.name, path.folder) != path.folder:
            failed[path.name] = f"{path.folder} has the name of {folder_of[path.name]}"
            continue
        try:
            log = Log(path)
            frames, digest = moments(log, index.settings.stride_s), log_digest(path)
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
    """Return the frames nearest to each multiple of `stride_s`, within the log's parts if it has any."""
    frame, valid = log.nearest_frames(np.arange(log.t_us[0], log.t_us[-1] + 1, stride_s * 1e6))
    frames = np.unique(frame[valid])
    if log.path.parts_s:
        t_s = (log.t_us[frames] - log.t_us[0]) * 1e-6
        frames = frames[np.any([(t_s >= start) & (t_s < end) for start, end in log.path.parts_s], axis=0)]
    return [int(frame) for frame in frames]


def log_digest(path: LogPath) -> str:
    """Return a hash of the names, sizes and modification times of a log's files."""
    digest = hashlib.sha256()
    for entry in sorted(os.scandir(path.folder), key=lambda entry: entry.name):
        facts = entry.stat()
        digest.update(f"{entry.name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]
