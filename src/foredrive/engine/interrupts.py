"""Interrupted and killed trainings: steps are completed, and no worker process is left behind."""

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

    # A local handler replaces the usual one; `interrupting_signals` has left out foreign handlers
    for number in before:
        signal.signal(number, note)
    try:
        yield lambda: pressed
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    # Raised after the handlers are restored, so that a further signal acts as usual
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
    # Before SIGINT is blocked: the fork server would start it, and its start unblocks SIGINT
    resource_tracker.ensure_running()
    # The fork server inherits the environment and the signal mask of this moment; both are then reset
    os.environ[SOCKETS] = multiprocessing.util.get_temp_dir()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        del os.environ[SOCKETS]


def end_with_parent(worker_id: int) -> None:
    """Make this worker process end when its parent has ended in any way, for example by `kill -9`.

    Neither the operating system nor PyTorch ends it: for them the worker's parent is the fork server, which
    lives as long as its workers.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    main = threading.get_ident()

    def watch() -> None:
        parent.join()
        # Interrupt the main thread, so that its job removes its unfinished files. A signal also wakes a
        # thread that sleeps or waits, but without a handler it would end the process at once
        if callable(signal.getsignal(signal.SIGTERM)):
            signal.pthread_kill(main, signal.SIGTERM)
        else:
            _thread.interrupt_main()
        until_s = time.monotonic() + CLEANUP_S
        time.sleep(PATIENCE_S)
        while writes_files() and time.monotonic() < until_s:
            time.sleep(PATIENCE_S)
        # Without Python's shutdown, which could wait for other threads
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
