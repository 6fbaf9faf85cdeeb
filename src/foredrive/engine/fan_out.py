"""Run many jobs at once, in processes or on Ray; a job that fails does not stop the others.

A job whose process dies is tried once more. When one process of a pool dies, all running jobs of the pool are
lost. Each of them is then tried alone, so that a job that kills its process does not affect other jobs.

An interruption reaches every worker. Each worker removes its unfinished files before the interruption is
raised.

Local work runs on the standard library's process pool. Ray would start a cluster of processes for two
workers. loky kills its workers, so that unfinished files would stay. Ray serves clusters.
"""

import contextlib
import logging
import multiprocessing
import os
import reprlib
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, TypeVar

import rich

from foredrive.debugging import debugging
from foredrive.engine.interrupts import end_with_parent, hold_interrupts, start_fork_server
from foredrive.errors import InputError
from foredrive.interrupts import LastingInterrupt

if TYPE_CHECKING:
    from types import FrameType

EXIT_TERMINATED = 143
LAST_WORDS_S = 60.0
"""Maximum time for Ray's tasks to remove their unfinished files, s."""

_DEATHS_ON_RAY = ("WorkerCrashedError", "OutOfMemoryError", "NodeDiedError", "LocalRayletDiedError")
"""Names of the ray.exceptions that report the death of a task's process. Ray itself is slow to import."""
_log = logging.getLogger(__name__)
J = TypeVar("J")
R = TypeVar("R")


def fan_out(
    jobs: Sequence[J], work: Callable[[J], R], workers: int, *, on_ray: bool = False, on_gpu: bool = False
) -> Generator[tuple[J, R | BaseException], None, None]:
    """Yield each job when it ends, with its result or its error; submit only as many jobs as run at a time.

    Close the generator to stop early (`contextlib.closing`).

    Args:
        work: must be picklable, as must the jobs and the results.
        workers: jobs at a time. On Ray it is the size of a cluster that is started here; a cluster that
            RAY_ADDRESS names is used as it is.
        on_gpu: whether a job computes on a GPU where there is one. In a cluster with GPUs each job then has
            one of its own; workers of this machine take them in turn, see `chosen_device`.
    """
    waiting, lost, running = deque(jobs), deque[J](), dict[Future[R], J]()
    if not jobs:
        return
    pool = _on_ray(work, workers, on_gpu=on_gpu) if on_ray else _on_processes(work, workers)
    with pool as (submit, width):
        _log.info("%d jobs, %d at a time", len(jobs), width)
        while waiting or lost or running:
            # Jobs that were lost with a process run one by one; new jobs start when none of them is left
            alone = bool(lost) and not running
            if alone:
                job = lost.popleft()
                running[submit(job)] = job
            while waiting and not lost and not alone and len(running) < width:
                job = waiting.popleft()
                running[submit(job)] = job
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, error = running.pop(future), future.exception()
                _log.info("%s: %s", reprlib.repr(job), "done" if error is None else repr(error))
                # A job that ran alone has broken the pool itself, so its second failure is final
                if isinstance(error, BrokenProcessPool) and not alone:
                    lost.append(job)
                else:
                    yield job, error or future.result()


def reason(name: str, error: BaseException) -> str:
    """Return the reason of a job's failure in one line.

    Raises:
        BaseException: the error itself, if the job did not cause it: a full disk, an interruption.
    """
    error = getattr(error, "cause", None) or error  # Ray wraps the error and its traceback in one of its own
    if isinstance(error, OSError) or not isinstance(error, Exception):
        raise error
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, BrokenProcessPool) or type(error).__name__ in _DEATHS_ON_RAY:
        return "its process died twice, maybe for want of memory"
    _log.warning("%s failed", name, exc_info=error)
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[-1]}"


@contextlib.contextmanager
def _on_processes(work: Callable[[J], R], workers: int) -> Iterator[tuple[Callable[[J], Future[R]], int]]:
    """Run jobs in worker processes, which remove their unfinished files at the end; replace a dead worker."""
    start_fork_server(preload=_module_of(work))
    context = multiprocessing.get_context("forkserver")
    # Workers stop when `alive` is closed, which also happens when this process is killed. An Event instead
    # would wait for ever for the wake-up of a worker that has died
    stop, alive = context.Pipe(duplex=False)
    pool: ProcessPoolExecutor | None = None

    def submit(job: J) -> Future[R]:
        nonlocal pool
        # A worker that is interrupted while it starts would print a traceback
        with hold_interrupts():
            if pool is not None:
                # A pool refuses all jobs once a worker has died; then it is replaced
                with contextlib.suppress(BrokenProcessPool):
                    return pool.submit(_unless_stopped, work, job)
                pool.shutdown()
            pool = ProcessPoolExecutor(workers, context, _start_worker, (stop,))
            return pool.submit(_unless_stopped, work, job)

    try:
        yield submit, workers
    finally:
        # First tell the workers to stop, then wait for them: they remove their unfinished files
        alive.close()
        if pool is not None:
            pool.shutdown(cancel_futures=True)
        stop.close()


class _Worker:
    """The state of a worker process."""

    is_busy = is_terminated = False
    interrupt = LastingInterrupt(lambda: _Worker.is_busy, once=True)


def _start_worker(stop: Connection) -> None:
    """Set up a worker: stop when the parent closes its end of the pipe, and by Ctrl-C and SIGTERM.

    The worker removes its unfinished files when it stops. The pool ends the workers, unless the parent was
    killed: then each worker ends on its own.
    """
    rich.get_console().quiet = True  # The parent shows the progress
    main = threading.get_ident()

    def watch() -> None:
        # Nothing is ever sent: this returns when the other end is closed
        stop.poll(None)
        signal.pthread_kill(main, signal.SIGINT)  # Also wakes a main thread that sleeps or waits

    def terminate(number: int, frame: "FrameType | None") -> None:
        # Without a job nothing has to be removed. With one, the process ends after the job's clean-up
        if not _Worker.is_busy:
            os._exit(EXIT_TERMINATED)
        _Worker.is_terminated = True
        _Worker.interrupt(number, frame)

    signal.signal(signal.SIGINT, _Worker.interrupt)
    signal.signal(signal.SIGTERM, terminate)
    # The fork server blocks SIGINT. Here it is handled, so that a job can remove its files
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=watch, daemon=True).start()
    end_with_parent(0)


def _unless_stopped(work: Callable[[J], R], job: J) -> R:
    if _Worker.interrupt.pressed:
        raise KeyboardInterrupt
    _Worker.is_busy = True
    try:
        with debugging(worker=True):
            return work(job)
    finally:
        _Worker.is_busy = False
        if _Worker.is_terminated:
            os._exit(EXIT_TERMINATED)


@contextlib.contextmanager
def _on_ray(
    work: Callable[[J], R], workers: int, *, on_gpu: bool
) -> Iterator[tuple[Callable[[J], Future[R]], int]]:
    """Run jobs as Ray tasks of one core each. At the end the tasks have removed their unfinished files."""
    import ray  # The import takes a second

    started_here = not ray.is_initialized()
    if started_here:
        cpus = None if "RAY_ADDRESS" in os.environ else workers
        ray.init(num_cpus=cpus, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    cluster = ray.cluster_resources()
    # Ray shows a task with a GPU that one alone
    gpus = int(cluster.get("GPU", 0)) if on_gpu else 0
    width = min(int(cluster["CPU"]), gpus) if gpus else int(cluster["CPU"])
    # Ray retries only if the process dies
    task: Any = ray.remote(num_cpus=1, num_gpus=1 if gpus else 0, max_retries=1)(_quietly)
    refs = {}

    def submit(job: J) -> Future[R]:
        ref = task.remote(work, job)
        future: Future[R] = ref.future()
        refs[future] = ref
        return future

    try:
        yield submit, width
    finally:
        # Cancel what still runs, and wait while the tasks remove their unfinished files
        under_way = [ref for future, ref in refs.items() if not future.done()]
        for ref in under_way:
            ray.cancel(ref)
        if under_way:
            ray.wait(under_way, num_returns=len(under_way), timeout=LAST_WORDS_S)
        if started_here:
            ray.shutdown()


def _quietly(work: Callable[[J], R], job: J) -> R:
    rich.get_console().quiet = True
    return work(job)


def _module_of(work: Any) -> str:
    """Return the module that defines a function or a partial; the fork server imports it before it forks."""
    return str(getattr(work, "func", work).__module__)
