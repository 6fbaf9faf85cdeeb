"""Ctrl-C between steps, and never in the middle of one."""

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from multiprocessing import forkserver, resource_tracker

from foredrive.interrupts import raises_interrupts


@contextlib.contextmanager
def hold_interrupts() -> Iterator[Callable[[], bool]]:
    """Note a first Ctrl-C, and raise it as KeyboardInterrupt at the end of the block only.

    A step that is interrupted halfway has changed some of the weights or statistics already: a checkpoint of
    it would be of no step at all. A second Ctrl-C is raised at once. Where Ctrl-C does not raise
    KeyboardInterrupt (outside the main thread, or with a handler of somebody else's) nothing is changed.

    Yields:
        a function that tells whether Ctrl-C was pressed, so that the block can come to its end.
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
    """Start the process that worker processes are forked from, if it does not run yet.

    It keeps SIGINT blocked, and its children inherit that: a terminal sends Ctrl-C to every process, but
    workers shall not die of it before the step is done that needs them.

    Args:
        preload: module that the workers need; it is imported once and not in each of them, and stays shared.
    """
    multiprocessing.set_forkserver_preload([preload, "foredrive.training.frozen"])
    resource_tracker.ensure_running()  # the fork server would start it, which unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
