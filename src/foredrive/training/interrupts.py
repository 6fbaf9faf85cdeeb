"""Interrupted and killed trainings: steps that are not cut in half, worker processes that do not stay."""

import _thread
import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing import forkserver, resource_tracker

from foredrive.interrupts import raises_interrupts

CLEANUP_S = 10.0
"""Time for a worker without a parent to remove its unfinished files."""


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


def end_with_parent(worker_id: int) -> None:
    """Make this worker process end when its parent has ended in any way, for example by `kill -9`.

    Nobody else does it. A worker's parent in the eyes of the operating system, and so of PyTorch, is the fork
    server, which lives as long as its workers.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        _thread.interrupt_main()
        time.sleep(CLEANUP_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
