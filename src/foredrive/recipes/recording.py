"""Recording many drives at once, over processes or over Ray.

Drives are independent and each ends in a log that is whole or not there: what an interrupted campaign has
recorded is not recorded again, and a drive that fails takes none of the others with it.
"""

import _thread
import contextlib
import functools
import logging
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import rich
import torch

from foredrive.data.cameras import pinhole_cameras
from foredrive.data.logs import Log, LogPath
from foredrive.errors import InputError
from foredrive.towns.campaign import DrivePlan
from foredrive.towns.conditions import find_conditions
from foredrive.towns.recorder import Crowd, record, split_of
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.sensing.rig import camera_rig, roof_lidar
from foredrive.training.interrupts import start_fork_server

LAST_WORDS_S = 60.0
"""How long Ray's tasks may take to clear away what they have half written."""

_log = logging.getLogger(__name__)
Submit = Callable[[DrivePlan], Future[None]]


@dataclass(frozen=True)
class Recorded:
    """What came of some drives."""

    logs: dict[DrivePlan, LogPath]
    """All that lie there whole now."""
    skipped: int
    """How many of them did so before."""
    failed: dict[DrivePlan, str]
    """Why there is no log of a drive, in one line."""


def record_drives(
    plans: Sequence[DrivePlan],
    out: Path,
    image_hw: tuple[int, int],
    workers: int,
    *,
    on_ray: bool = False,
    tick: Callable[[], None] = lambda: None,
) -> Recorded:
    """Record all drives that do not lie in the data root yet; the bytes are those of `record`.

    Args:
        out: 123D data root; of a Ray cluster with several machines one that they share.
        image_hw: of the six cameras.
        workers: drives recorded at a time. On Ray that is the size of a cluster which is started here; one
            that RAY_ADDRESS names is used as it is.
        tick: called as each drive is done with.

    Raises:
        OSError: the disk is full; no other drive would fare better.
    """
    logs, failed = {}, {}
    for plan in plans:
        if is_recorded(plan, out, image_hw):
            logs[plan] = log_of(plan, out)
            tick()
    skipped = len(logs)
    todo = [plan for plan in plans if plan not in logs]
    threads = max(1, torch.get_num_threads() // workers)
    work = functools.partial(record_plan, out=out, image_hw=image_hw, threads=threads)
    with contextlib.closing(_results(todo, work, workers, on_ray)) as results:
        for plan, error in results:
            if error is None:
                logs[plan] = log_of(plan, out)
            else:
                failed[plan] = _reason(plan, error)
            tick()
    return Recorded({plan: logs[plan] for plan in plans if plan in logs}, skipped, failed)


def record_plan(plan: DrivePlan, out: Path, image_hw: tuple[int, int], threads: int | None = None) -> LogPath:
    """Record one drive, on as many threads."""
    if threads is not None:
        torch.set_num_threads(threads)
    return record(
        plan.town,
        plan.seconds,
        plan.seed,
        out,
        plan.rate_hz,
        SensorSuite(camera_rig(image_hw), roof_lidar()),
        Crowd(plan.vehicles, plan.people),
        conditions=None if plan.conditions is None else find_conditions(plan.conditions),
        log_name=plan.log_name,
    )


def log_of(plan: DrivePlan, out: Path) -> LogPath:
    """Where the log of a drive lies, or will."""
    return LogPath(out / "logs" / split_of(plan.town) / plan.log_name, out / "maps")


def is_recorded(plan: DrivePlan, out: Path, image_hw: tuple[int, int]) -> bool:
    """Whether the log is there, with the length, the rate and the images that are wanted."""
    path = log_of(plan, out)
    if not path.folder.is_dir():
        return False
    try:
        log = Log(path)
    except InputError:
        return False
    sizes = {(camera.height, camera.width) for camera in pinhole_cameras(log).values()}
    rate_fits = plan.frames == 1 or abs(log.period_s * plan.rate_hz - 1) < 1e-3
    return len(log) == plan.frames and sizes == {image_hw} and rate_fits


def _reason(plan: DrivePlan, error: BaseException) -> str:
    """Why a drive failed; what is no drive's own fault is raised."""
    error = getattr(error, "cause", None) or error  # Ray wraps it, with its traceback as text
    if isinstance(error, OSError) or not isinstance(error, Exception):
        raise error
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, BrokenProcessPool):
        return "its process died, maybe for want of memory"
    _log.warning("%s failed", plan.log_name, exc_info=error)
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[-1]}"


def _results(
    plans: Sequence[DrivePlan], work: Callable[[DrivePlan], object], workers: int, on_ray: bool
) -> Generator[tuple[DrivePlan, BaseException | None], None, None]:
    """Drives as they end, and what they failed of; never more under way than are worked on."""
    waiting, running = deque(plans), dict[Future[None], DrivePlan]()
    if not plans:
        return
    with (_on_ray if on_ray else _on_processes)(work, workers) as (submit, width):
        while waiting or running:
            while waiting and len(running) < width:
                plan = waiting.popleft()
                running[submit(plan)] = plan
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.exception()


@contextlib.contextmanager
def _on_processes(work: Callable[[DrivePlan], object], workers: int) -> Iterator[tuple[Submit, int]]:
    """Worker processes, anew after one has died; at the end they have cleared away what is half-written."""
    start_fork_server(preload=record_plan.__module__)
    context = multiprocessing.get_context("forkserver")
    stop, alive = context.Pipe(duplex=False)  # an event would wait for ever for a process that has died
    pool: ProcessPoolExecutor | None = None

    def submit(plan: DrivePlan) -> Future[None]:
        nonlocal pool
        if pool is not None:
            with contextlib.suppress(BrokenProcessPool):
                return pool.submit(_unless_stopped, work, plan)
            pool.shutdown()
        pool = ProcessPoolExecutor(workers, context, _start_worker, (stop,))
        return pool.submit(_unless_stopped, work, plan)

    try:
        yield submit, workers
    finally:
        alive.close()
        if pool is not None:
            pool.shutdown(cancel_futures=True)
        stop.close()


class _Worker:
    """What a worker process knows of itself."""

    is_busy = False
    has_to_stop = False


def _start_worker(stop: Connection) -> None:
    """Stop when the parent closes its end of a pipe, not by Ctrl-C; clear away what is half-written."""
    rich.get_console().quiet = True  # the parent shows how far it is

    def interrupt(signum: int, frame: object) -> None:
        if not _Worker.has_to_stop:
            _Worker.has_to_stop = True
            if _Worker.is_busy:
                raise KeyboardInterrupt

    def watch() -> None:
        stop.poll(None)
        _thread.interrupt_main()

    signal.signal(signal.SIGINT, interrupt)
    threading.Thread(target=watch, daemon=True).start()


def _unless_stopped(work: Callable[[DrivePlan], object], plan: DrivePlan) -> None:
    if _Worker.has_to_stop:
        raise KeyboardInterrupt
    _Worker.is_busy = True
    try:
        work(plan)
    finally:
        _Worker.is_busy = False


@contextlib.contextmanager
def _on_ray(work: Callable[[DrivePlan], object], workers: int) -> Iterator[tuple[Submit, int]]:
    """Ray's tasks of one core each; at the end they have cleared away what is half-written."""
    import ray  # takes a second

    started_here = not ray.is_initialized()
    if started_here:
        cpus = None if "RAY_ADDRESS" in os.environ else workers
        ray.init(num_cpus=cpus, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    task = ray.remote(num_cpus=1, max_retries=0)(_quietly)
    refs = {}

    def submit(plan: DrivePlan) -> Future[None]:
        ref = task.remote(work, plan)
        future: Future[None] = ref.future()
        refs[future] = ref
        return future

    try:
        yield submit, int(ray.cluster_resources()["CPU"])
    finally:
        under_way = [ref for future, ref in refs.items() if not future.done()]
        for ref in under_way:
            ray.cancel(ref)
        if under_way:
            ray.wait(under_way, num_returns=len(under_way), timeout=LAST_WORDS_S)
        if started_here:
            ray.shutdown()


def _quietly(work: Callable[[DrivePlan], object], plan: DrivePlan) -> None:
    rich.get_console().quiet = True
    work(plan)
