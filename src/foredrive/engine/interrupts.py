"""Interrupted and killed trainings: steps that are not cut in half, worker processes that do not stay."""

import _thread
import contextlib
import multiprocessing
import multiprocessing.util
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing import forkserver, resource_tracker

from foredrive.engine.frozen import SOCKETS
from foredrive.files import writes_files
from foredrive.interrupts import PATIENCE_S, interrupting_signals

CLEANUP_S = 10.0
"""Longest time for a worker without a parent to remove its unfinished files. It ends when there are none."""


@contextlib.contextmanager
def hold_interrupts() -> Iterator[Callable[[], bool]]:
    """Record a first Ctrl-C or SIGTERM and raise it as KeyboardInterrupt only at the end of the block.

    A step interrupted halfway has already changed some weights or statistics, so a checkpoint then would
    belong to no step. A second Ctrl-C is raised at once. Where Ctrl-C does not raise KeyboardInterrupt
    (outside the main thread, or with a foreign handler) nothing is changed.

    Yields:
        a function that returns whether Ctrl-C was pressed, so that the block can end.
    """
    before, pressed = {number: signal.getsignal(number) for number in interrupting_signals()}, False

    def note(signum: int, frame: object) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    for number in before:
        signal.signal(number, note)
    try:
        yield lambda: pressed
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if pressed:
        raise KeyboardInterrupt


def start_fork_server(preload: str) -> None:
    """Start the process that worker processes are forked from, if it is not running yet.

    It keeps SIGINT blocked, and its children inherit that. A terminal sends Ctrl-C to every process, but
    workers must not die before the step that needs them is done.

    Args:
        preload: module that the workers need. It is imported once, not in each worker, and stays shared.
    """
    multiprocessing.set_forkserver_preload([preload, "foredrive.engine.frozen"])
    resource_tracker.ensure_running()  # the fork server would start it, which unblocks SIGINT
    os.environ[SOCKETS] = multiprocessing.util.get_temp_dir()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        del os.environ[SOCKETS]


def end_with_parent(worker_id: int) -> None:
    """Make this worker process end when its parent has ended in any way, for example by `kill -9`.

    Nobody else does it. A worker's parent in the eyes of the operating system, and so of PyTorch, is the fork
    server, which lives as long as its workers.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    main = threading.get_ident()

    def watch() -> None:
        parent.join()
        if callable(signal.getsignal(signal.SIGTERM)):
            signal.pthread_kill(main, signal.SIGTERM)  # wakes a thread that sleeps or waits, too
        else:
            _thread.interrupt_main()
        until_s = time.monotonic() + CLEANUP_S
        time.sleep(PATIENCE_S)
        while writes_files() and time.monotonic() < until_s:
            time.sleep(PATIENCE_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
