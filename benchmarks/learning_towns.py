"""Record the towns that `learning` trains and tests on: `python benchmarks/learning_towns.py --out FOLDER`.

252 drives of a minute over the seven training towns at 2 Hz (about three CPU hours, 11 GB), and six drives
through Town05. Complete drives are skipped, so that an interrupted command can be started again.

Every other drive is in bright daylight; the others take all conditions in turn. Two drives in three vary the
camera rig: mounts, heights, directions and fields of view. The test drives keep the nominal rig.
"""

import argparse
import dataclasses
import hashlib
import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import exp_se3
from foredrive.runs.drive.recording import log_of
from foredrive.scene import CameraRig
from foredrive.scene.conditions import BackgroundTraffic, find_conditions
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.campaign import ANY_CONDITIONS, Campaign, DrivePlan, plan_drives
from foredrive.towns.recorder import record
from foredrive.towns.sensing.capture import SensorSuite

TRAIN_TOWNS = ("Town01", "Town02", "Town03", "Town04", "Town06", "Town07", "Town10HD")
TEST_TOWNS = ("Town05",)
TRAIN_SEEDS, TEST_SEEDS = tuple(range(1, 37)), tuple(range(1, 7))
SECONDS, RATE_HZ, IMAGE_HW = 60.0, 2.0, (144, 256)
VEHICLES, PEOPLE = (15, 60), (10, 40)
SHIFT_M, RAISE_M, TURN_DEG, TILT_DEG, ZOOM = 0.2, 0.3, 6.0, 2.0, 1.2
"""Maximum changes: shift of one camera (m), height of all cameras (m), rotation and tilt of one camera
(degrees), and zoom.
"""
DIGEST = "3b85bf07acb3097b"
"""Digest of all drives and rigs, without the code that records them. Planning the drives takes a minute,
which is too long for an import of what depends on them.
"""


def plan_learning() -> list[DrivePlan]:
    """Return the test drives, then the training drives by seed and then by town.

    Raises:
        RuntimeError: they are not the drives of `DIGEST`.
    """
    test = plan_drives(Campaign(TEST_TOWNS, TEST_SEEDS, seconds=SECONDS, rate_hz=RATE_HZ))
    train = []
    for conditions, seeds in (((), TRAIN_SEEDS[1::2]), ((ANY_CONDITIONS,), TRAIN_SEEDS[::2])):
        train += plan_drives(
            Campaign(TRAIN_TOWNS, seeds, conditions, VEHICLES, PEOPLE, seconds=SECONDS, rate_hz=RATE_HZ)
        )
    plans = test + sorted(train, key=lambda plan: (plan.seed, TRAIN_TOWNS.index(plan.town)))
    rigs = (SHIFT_M, RAISE_M, TURN_DEG, TILT_DEG, ZOOM)
    digest = hashlib.sha256(repr((plans, rigs, IMAGE_HW)).encode()).hexdigest()[:16]
    if digest != DIGEST:
        raise RuntimeError(f"the drives have changed: their DIGEST is {digest}")
    return plans


def rig_of(plan: DrivePlan) -> CameraRig:
    """Return the nominal rig for testing and every third seed, otherwise a rig drawn from town and seed."""
    nominal = camera_rig(IMAGE_HW)
    if plan.town in TEST_TOWNS or plan.seed % 3 == 0:
        return nominal
    rng = np.random.default_rng([plan.seed, *plan.town.encode(), *b"rig"])
    raised_m = rng.uniform(-RAISE_M, RAISE_M)
    T_ego_cam = torch.stack([_moved(T, rng, raised_m) for T in nominal.T_ego_cam])
    K = nominal.K.clone()
    K[:, 0, 0] *= torch.from_numpy(ZOOM ** rng.uniform(-1.0, 1.0, len(K))).float()
    K[:, 1, 1] = K[:, 0, 0]
    return dataclasses.replace(nominal, K=K, T_ego_cam=T_ego_cam)


def _moved(
    T_ego_cam: Float[Tensor, "4 4"], rng: np.random.Generator, raised_m: float
) -> Float[Tensor, "4 4"]:
    """Turn a camera about its own axes (right: tilt, down: heading, forward: roll) and shift it."""
    turn_rad = rng.uniform(-1.0, 1.0, 3) * np.radians([TILT_DEG, TURN_DEG, 0.5 * TILT_DEG])
    twist = torch.tensor([0.0, 0.0, 0.0, *turn_rad], dtype=torch.float32)
    moved = T_ego_cam @ exp_se3(twist)
    shift_m = np.append(rng.uniform(-SHIFT_M, SHIFT_M, 2), raised_m)
    moved[:3, 3] += torch.from_numpy(shift_m).float()
    return moved


def record_missing(plans: Sequence[DrivePlan], out: Path) -> None:
    """Record the drives that `out` lacks, one after another."""
    for number, plan in enumerate(plans):
        if log_of(plan, out).folder.is_dir():
            continue
        start_s = time.process_time()
        record(
            plan.town,
            plan.seconds,
            plan.seed,
            out,
            plan.rate_hz,
            SensorSuite(rig_of(plan), roof_lidar()),
            BackgroundTraffic(plan.vehicles, plan.people),
            conditions=None if plan.conditions is None else find_conditions(plan.conditions),
            log_name=plan.log_name,
        )
        took_s = time.process_time() - start_s
        print(f"{number + 1}/{len(plans)} {plan.log_name}: {math.ceil(took_s)} s of CPU", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="123D data root")
    record_missing(plan_learning(), parser.parse_args().out)


if __name__ == "__main__":
    main()
