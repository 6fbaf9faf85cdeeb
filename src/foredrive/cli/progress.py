"""Progress of verbs: frames whose number is not known in advance, or jobs of a known number.

In a terminal it is a bar on stderr. Elsewhere, as in log files of clusters, it is a line every half minute.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T")
EVERY_S = 30.0
"""Time between two lines, s."""


@contextmanager
def progress_lines(
    text: Callable[[], str], every_s: float = EVERY_S, write: Callable[[str], None] | None = None
) -> Iterator[None]:
    """Write a line with a text and the time since the beginning, repeatedly until the block ends.

    Args:
        text: returns the activity and its progress.
        every_s: time between two lines, s.
        write: receives a line; by default it is printed on stderr.
    """
    started, ended = time.monotonic(), threading.Event()

    def write_lines() -> None:
        while not ended.wait(every_s):
            line = f"{text()}, {duration(time.monotonic() - started)}"
            if write is None:
                print(line, file=sys.stderr, flush=True)
            else:
                write(line)

    thread = threading.Thread(target=write_lines, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def frame_progress(doing: str) -> Iterator[Callable[[], None]]:
    """Show the activity, the number of frames and the time; yield the function that counts a frame."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    frames = 0
    if not sys.stderr.isatty():

        def count() -> None:
            nonlocal frames
            frames += 1

        with progress_lines(lambda: f"{doing}: {frames} frames" if frames else doing):
            yield count
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=_stderr(), transient=True) as progress:
        bar = progress.add_task(doing, total=None)

        def tick() -> None:
            nonlocal frames
            frames += 1
            progress.update(bar, description=f"{doing}: {frames} frames")

        yield tick


@contextmanager
def job_progress(doing: str, total: int) -> Iterator[Callable[[], None]]:
    """Show how many of all jobs are done, and the expected time; yield the function that counts a job."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    if not sys.stderr.isatty():
        done, started = 0, time.monotonic()

        def count() -> None:
            nonlocal done
            done += 1

        with progress_lines(lambda: job_text(doing, done, total, time.monotonic() - started)):
            yield count
        return
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(doing, *columns, console=_stderr()) as progress:
        bar = progress.add_task("", total=total)
        yield lambda: progress.advance(bar)


def counted(items: Iterable[T], tick: Callable[[], None]) -> Iterator[T]:
    """Yield the items. Count each one when the next one is requested, because it is finished then."""
    for item in items:
        yield item
        tick()


def job_text(doing: str, done: int, total: int, elapsed_s: float) -> str:
    """Return how many jobs are done, and the time that the others will take at this rate."""
    text = f"{doing}: {done} of {total}"
    return f"{text}, {duration(elapsed_s * (total - done) / done)} left" if 0 < done < total else text


def duration(seconds: float) -> str:
    """Return a duration in words, such as "45 s", "3 min 20 s" or "2 h 5 min"."""
    whole = round(seconds)
    hours, minutes = whole // 3600, whole // 60 % 60
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {whole % 60} s" if minutes else f"{whole} s"


def _stderr() -> "Console":
    from rich.console import Console

    return Console(stderr=True)
