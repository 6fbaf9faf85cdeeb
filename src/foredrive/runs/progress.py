"""Show the progress of long work to a caller: an activity with a number of parts."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext

Progress = Callable[[str, int], AbstractContextManager[Callable[[], None]]]
"""Shows an activity and its number of parts; the function is called after each part."""


def silent(what: str, count: int) -> AbstractContextManager[Callable[[], None]]:
    """Show nothing."""
    return nullcontext(lambda: None)


@contextlib.contextmanager
def fraction(progress: Progress, what: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that takes the number of finished parts and of all parts, for `progress`."""
    with contextlib.ExitStack() as stack:
        ticks: list[Callable[[], None]] = []
        finished = 0

        def tick(done: int, total: int) -> None:
            nonlocal finished
            if not ticks:
                ticks.append(stack.enter_context(progress(what, total)))
            for _ in range(done - finished):
                ticks[0]()
            finished = done

        yield tick
