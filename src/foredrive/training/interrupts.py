"""Ctrl-C handling: interrupts take effect between training steps."""

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from multiprocessing import forkserver, resource_tracker

from foredrive.interrupts import raises_interrupts


@contextlib.contextmanager
def hold_interrupts() -> Iterator[Callable[[], bool]]:
    """Record a first Ctrl-C and raise it as KeyboardInterrupt only at the end of the block.

    A step interrupted halfway has already changed some weights or statistics, so a checkpoint then would
    belong to no step. A second Ctrl-C is raised at once. Where Ctrl-C does not raise KeyboardInterrupt
    (outside the main thread, or with a foreign handler) nothing is changed.

    Yields:
        a function that returns whether Ctrl-C was pressed, so that the block can end.
    """
    if not raises_interrupts():
        yield lambda: False
        return
    before, pressed = signal.getsignal(signal.SIGINT), False

    def note(signum: int, frame: object) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def start_fork_server(preload: str) -> None:
    """Start the process that worker processes are forked from, if it is not running yet.

    It keeps SIGINT blocked, and its children inherit that. A terminal sends Ctrl-C to every process, but
    workers must not die before the step that needs them is done.

    Args:
        preload: module that the workers need. It is imported once, not in each worker, and stays shared.
    """
    multiprocessing.set_forkserver_preload([preload, "foredrive.training.frozen"])
    resource_tracker.ensure_running()  # the fork server would start it, which unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
