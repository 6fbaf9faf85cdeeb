"""Progress of verbs: frames of a number that is not known before, or jobs of a known number."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def frame_progress(doing: str) -> Iterator[Callable[[], None]]:
    """Show what is done, the number of frames and the time; yield the function that counts a frame."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task(doing, total=None)
        frames = 0

        def tick() -> None:
            nonlocal frames
            frames += 1
            progress.update(bar, description=f"{doing}: {frames} frames")

        yield tick


@contextmanager
def job_progress(doing: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar over all jobs; yield the function that advances it by one."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(doing, *columns) as progress:
        bar = progress.add_task("", total=total)
        yield lambda: progress.advance(bar)
