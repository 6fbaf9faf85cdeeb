"""Measure how much a driver depends on its inputs: `foredrive bench drive-robustness`, hours on two cores.

The agent is the driver of the package, or the one that FOREDRIVE_AGENT names. Each arm drives the same
routes in the same traffic with one fault; seeds are repetitions. Drives are kept in
runs/drive_robustness/COMMIT.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.study import work_folder
from foredrive.driving.faults import CameraFault, Faults
from foredrive.errors import InputError
from foredrive.runs.drive.agent_inputs import rig_of
from foredrive.runs.drive.compare import values_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.sensors.rigs import TELE, RigPlan

WORK = work_folder(Path("runs/drive_robustness"))
AGENT = os.environ.get("FOREDRIVE_AGENT", "embedded")
ROUTES = "town05-short"
FRONT = "PCAM_F0"
FROM_S = 3.0
"""Time at which cameras fail: the drive has begun."""
RAISED_M, TURNED_DEG = 0.5, 2.0


def scores(
    seed: int,
    name: str,
    changed_rig: Callable[[RigPlan], RigPlan] | None = None,
    conditions: str | None = None,
    **changes: Any,
) -> Mapping[str, float]:
    """Return the figures of one repetition with a fault.

    Args:
        seed: seed of the traffic.
        name: name of the arm.
        changed_rig: returns another rig of cameras, which the agent was not trained with.
        conditions: time and weather; by day without.
        changes: fields of the suite.
    """
    agent = str(Path(AGENT).absolute()) if Path(AGENT).is_dir() else AGENT
    rig = rig_of(agent)
    other = rig if changed_rig is None else changed_rig(rig)
    source = TownRoutes(
        ROUTES, seed=seed, rig=other, other_rig=changed_rig is not None, conditions=conditions
    )
    suite = dataclasses.replace(DriveSuite(agent, source, sensors=False), **changes)
    for fault in suite.faults.cameras:
        if fault.camera not in rig.cameras:
            raise InputError(f"{name}: {AGENT} has no camera {fault.camera}; leave out this arm")
    driven = drive_suite(suite, WORK / f"{name}_seed{seed}", len(os.sched_getaffinity(0)))
    if driven.broken:
        job, why = next(iter(driven.broken.items()))
        raise InputError(f"{len(driven.broken)} drives failed, {job.name}: {why}")
    values = [values_of(drive) for drive in driven.drives.values()]

    def mean(key: str) -> float:
        return sum(value[key] for value in values) / len(values)

    return {
        "ds": mean("driving_score_1_0"),
        "rc": mean("completion"),
        "red_lights": len(values) * mean("red_lights"),
        "collisions": len(values) * mean("collisions"),
    }


def arm(name: str, **changes: Any) -> Callable[[int], Mapping[str, float]]:
    """Return an arm with a fault; its arguments are those of `scores`."""
    return lambda seed: scores(seed, name, **changes)


CHANGES: Mapping[str, Mapping[str, Any]] = {
    "untouched": {},
    **{
        f"{kind}_{place}": {"faults": Faults(cameras=(CameraFault(kind, camera, FROM_S),))}
        for place, camera in (("front", FRONT), ("tele", TELE))
        for kind in ("lost", "black", "frozen")
    },
    "speed_noise": {"faults": Faults(speed_noise_mps=0.5)},
    "position_noise": {"faults": Faults(position_noise_m=1.0)},
    **{f"latency_{ms}ms": {"latency_s": ms / 1000} for ms in (300, 500)},
    "halved_frames": {
        "faults": Faults(cameras=tuple(CameraFault("halved", place) for place in (FRONT, TELE)))
    },
    "raised_cameras": {"changed_rig": lambda rig: rig.raised(RAISED_M)},
    "turned_cameras": {"changed_rig": lambda rig: rig.turned(TURNED_DEG)},
    **{name: {"conditions": name} for name in ("night", "rain", "fog")},
}
"""The untouched drives have the usual latency of 0.1 s."""

BENCHMARK = Benchmark(
    question="How much of its score does a driver lose when an input fails?",
    arms={name: arm(name, **changes) for name, changes in CHANGES.items()},
    config={
        "agent": AGENT,
        "routes": ROUTES,
        "from_s": FROM_S,
        "raised_m": RAISED_M,
        "turned_deg": TURNED_DEG,
    },
    decided_by=("foredrive.driving", "foredrive.towns", "foredrive.methods"),
)
