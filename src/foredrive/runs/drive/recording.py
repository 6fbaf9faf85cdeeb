"""Recording many drives at once, over processes or over Ray.

Drives are independent and each ends in a log that is whole or not there: what an interrupted campaign has
recorded is not recorded again, and a drive that fails takes none of the others with it.
"""

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from foredrive.data.cameras import pinhole_cameras
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.runs.fan_out import fan_out, reason
from foredrive.towns.campaign import DrivePlan
from foredrive.towns.conditions import find_conditions
from foredrive.towns.recorder import Crowd, record, split_of
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.sensing.rig import camera_rig, roof_lidar


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
    with contextlib.closing(fan_out(todo, work, workers, on_ray=on_ray)) as results:
        for plan, result in results:
            if isinstance(result, BaseException):
                failed[plan] = reason(plan.log_name, result)
            else:
                logs[plan] = result
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
