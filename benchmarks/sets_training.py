"""What the likelihood of sets does to a detector: trained by matching, then by it, then calibrated.

A detection head on a volume of lidar hits learns from drives in towns and is judged in Town05, which it has
not seen. Both arms that are trained go on from the same head for equally many steps:
`foredrive bench sets-training`.
"""

import functools
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch

from foredrive.evaluation import Benchmark
from foredrive.models.detection import DetectionHead
from foredrive.recipes.demo import camera_rig, roof_lidar
from foredrive.recipes.detection import CLASSES, DetectionSample, detection_samples, judge, unexplained
from foredrive.scene import VoxelSpec
from foredrive.sets import fit_set_calibration
from foredrive.towns.recorder import LabelKinds, record
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.training.detection import Loss, fit_head, matching_loss, said_of, set_loss

SPEC = VoxelSpec(lower_m=(-32.0, -32.0, -1.0), voxel_m=1.0, shape_zyx=(4, 64, 64))
TRAIN, CALIBRATE, TEST = ("Town01", "Town02", "Town03", "Town04", "Town10HD"), ("Town07",), ("Town05",)
SECONDS, RATE_HZ = 30.0, 2.0
FIRST_STEPS, MORE_STEPS, BATCH, LEARNING_RATE = 500, 250, 8, 1e-3
IMAGE_HW = (16, 28)
"""Nothing looks at the images."""


@functools.cache
def samples(towns: tuple[str, ...]) -> list[DetectionSample]:
    """Of each town's drive."""
    sensors = SensorSuite(camera_rig(IMAGE_HW), roof_lidar())
    labels = LabelKinds(occupancy=None, visibility=False, captions=False)
    with tempfile.TemporaryDirectory() as folder:
        return [
            sample
            for town in towns
            for sample in detection_samples(
                record(town, SECONDS, 0, Path(folder), rate_hz=RATE_HZ, sensors=sensors, labels=labels), SPEC
            )
        ]


def train(head: DetectionHead, loss: Loss, steps: int, seed: int) -> DetectionHead:
    torch.set_num_threads(1)
    data = [sample[:2] for sample in samples(TRAIN)]
    return fit_head(head, data, loss, steps=steps, batch=BATCH, learning_rate=LEARNING_RATE, seed=seed)


@functools.cache
def first(seed: int) -> DetectionHead:
    """The head that all arms go on from."""
    torch.manual_seed(seed)
    return train(DetectionHead(SPEC, channels=1, classes=len(CLASSES)), matching_loss, FIRST_STEPS, seed)


@functools.cache
def trained(loss: Loss, seed: int) -> DetectionHead:
    """The head after more steps with a loss."""
    return train(first(seed), loss, MORE_STEPS, seed + 100)


def as_trained(loss: Loss) -> Callable[[int], dict[str, float]]:
    """In the town that was held out."""

    def measure(seed: int) -> dict[str, float]:
        test = samples(TEST)
        return judge(said_of(trained(loss, seed), [s.volume for s in test]), test, SPEC)

    return measure


def calibrated(loss: Loss) -> Callable[[int], dict[str, float]]:
    """Existence by isotonic regression and covariances by one factor, fitted in a town of its own."""

    def measure(seed: int) -> dict[str, float]:
        head, apart, test = trained(loss, seed), samples(CALIBRATE), samples(TEST)
        said = said_of(head, [s.volume for s in apart])
        mend = fit_set_calibration(said, [s.objects for s in apart], unexplained(SPEC))
        return judge([mend(found) for found in said_of(head, [s.volume for s in test])], test, SPEC)

    return measure


BENCHMARK = Benchmark(
    question="What does training by set likelihood do to likelihood, calibration and mAP?",
    arms={
        "matching": as_trained(matching_loss),
        "mb_nll": as_trained(set_loss),
        "matching_calibrated": calibrated(matching_loss),
        "mb_nll_calibrated": calibrated(set_loss),
    },
    config={
        "train": TRAIN, "calibrate": CALIBRATE, "test": TEST, "seconds": SECONDS, "rate_hz": RATE_HZ,
        "first_steps": FIRST_STEPS, "more_steps": MORE_STEPS, "batch": BATCH, "rate": LEARNING_RATE,
    },
)  # fmt: skip
