"""Record many drives at once, in processes or on Ray.

Drives are independent. The log of a drive is either complete or absent. A campaign that is started again
skips the complete logs, and a drive that fails does not stop the others.
"""

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from foredrive.data.cameras import rig_of_log
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.engine.fan_out import fan_out, reason
from foredrive.errors import InputError
from foredrive.files import remove_abandoned, sole_writer
from foredrive.scene.conditions import BackgroundTraffic, find_conditions
from foredrive.sensors.rigs import RigPlan, camera_rig, same_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns import virtual_egos
from foredrive.towns.campaign import DrivePlan
from foredrive.towns.recorder import OCCUPANCY, record, split_of
from foredrive.towns.sensing.capture import SensorSuite


@dataclass(frozen=True)
class RecordingResult:
    """The result of recording several drives."""

    logs: dict[DrivePlan, LogPath]
    """The complete logs."""
    skipped: int
    """Number of logs that were complete before."""
    failed: dict[DrivePlan, str]
    """The reason in one line for each drive that has no log."""


def record_drives(
    plans: Sequence[DrivePlan],
    out: Path,
    rig: RigPlan,
    workers: int,
    *,
    on_ray: bool = False,
    tick: Callable[[], None] = lambda: None,
) -> RecordingResult:
    """Record all drives that are not in the data root yet.

    The bytes are the same as from `record`.

    Args:
        out: 123D data root; on a Ray cluster with several machines, a folder that they share.
        rig: cameras of every drive.
        workers: number of drives recorded at a time. On Ray it is the size of the cluster that is started
            here; a cluster that RAY_ADDRESS names is used as it is.
        tick: called after each drive.

    Raises:
        OSError: the disk is full, so that no other drive could be recorded.
    """
    logs, failed = {}, {}
    for folder in {log_of(plan, out).folder.parent for plan in plans}:
        remove_abandoned(folder)  # also if all logs are there
    for plan in plans:
        if is_recorded(plan, out, rig):
            logs[plan] = log_of(plan, out)
            tick()
    skipped = len(logs)
    todo = [plan for plan in plans if plan not in logs]
    threads = max(1, torch.get_num_threads() // workers)
    work = functools.partial(record_plan, out=out, rig=rig, threads=threads)
    with contextlib.closing(fan_out(todo, work, workers, on_ray=on_ray)) as results:
        for plan, result in results:
            if isinstance(result, BaseException):
                failed[plan] = reason(plan.log_name, result)
            else:
                logs[plan] = result
            tick()
    return RecordingResult({plan: logs[plan] for plan in plans if plan in logs}, skipped, failed)


def record_plan(plan: DrivePlan, out: Path, rig: RigPlan, threads: int | None = None) -> LogPath:
    """Record one drive with this number of threads; None keeps the number."""
    if threads is not None:
        torch.set_num_threads(threads)
    path = log_of(plan, out)
    with sole_writer(path.folder):
        if is_recorded(plan, out, rig):  # by another process since this one began
            return path
        return record(
            plan.town,
            plan.seconds,
            plan.seed,
            out,
            plan.rate_hz,
            SensorSuite(camera_rig(plan=rig), roof_lidar()),
            BackgroundTraffic(plan.vehicles, plan.people),
            conditions=None if plan.conditions is None else find_conditions(plan.conditions),
            log_name=plan.log_name,
        )


def log_of(plan: DrivePlan, out: Path) -> LogPath:
    """Return the path of a drive's log, whether it exists or not."""
    return LogPath(out / "logs" / split_of(plan.town) / plan.log_name, out / "maps")


def is_recorded(plan: DrivePlan, out: Path, rig: RigPlan) -> bool:
    """Return whether the log exists with the planned length, rate and cameras."""
    path = log_of(plan, out)
    if not path.folder.is_dir():
        return False
    try:
        log = Log(path)
    except InputError:
        return False
    rate_fits = plan.frames == 1 or abs(log.period_s * plan.rate_hz - 1) < 1e-3
    return len(log) == plan.frames and rate_fits and same_rig(rig_of_log(log), rig)


@dataclass(frozen=True)
class EgosPlan:
    """The virtual egos of one town and seed."""

    town: str
    seed: int
    count: int
    conditions: tuple[str, ...] = ()
    """Names of `CONDITIONS`, of which one is drawn for each ego. Empty: bright daylight."""
    occupancy: bool = False
    """Record exact occupancy with flow."""
    lidar: bool = False
    """Record the sweep of the lidar on the roof beside the images."""
    per_window: int = virtual_egos.EGOS_PER_WINDOW
    """Most egos of the same time of the traffic. With fewer, a log takes longer and more traffic is seen."""

    @property
    def name(self) -> str:
        """Return the name for messages."""
        return f"virtual egos of {self.town}, seed {self.seed}"


def record_egos(
    plans: Sequence[EgosPlan],
    out: Path,
    rig: RigPlan,
    workers: int,
    *,
    on_ray: bool = False,
    tick: Callable[[], None] = lambda: None,
) -> tuple[list[LogPath], dict[str, str]]:
    """Record virtual egos; logs that are in the data root are kept.

    Args:
        out, rig, workers, on_ray: as of `record_drives`.
        tick: called after the egos of each town and seed.

    Returns:
        The logs, and the reason in one line for each town and seed that failed.
    """
    logs, failed = list[LogPath](), dict[str, str]()
    for town in {plan.town for plan in plans}:
        remove_abandoned(out / "logs" / virtual_egos.split_of(town))
    work = functools.partial(_record_egos, out=out, rig=rig)
    with contextlib.closing(fan_out(plans, work, workers, on_ray=on_ray)) as results:
        for plan, result in results:
            if isinstance(result, BaseException):
                failed[plan.name] = reason(plan.name, result)
            else:
                logs += result
            tick()
    return logs, failed


def _record_egos(plan: EgosPlan, out: Path, rig: RigPlan) -> list[LogPath]:
    torch.set_num_threads(1)
    sensors = SensorSuite(camera_rig(plan=rig), roof_lidar() if plan.lidar else None)
    conditions = [find_conditions(name) for name in plan.conditions]
    spec = OCCUPANCY if plan.occupancy else None
    return virtual_egos.record_virtual_egos(
        plan.town, plan.seed, plan.count, out, sensors, conditions, spec, egos_per_window=plan.per_window
    )
