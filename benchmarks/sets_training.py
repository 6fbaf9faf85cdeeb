"""Effect of a detector's loss: matching, energy score or set likelihood; Gaussian or Laplace; calibrated.

A detection head on a volume of lidar hits is trained on drives in towns and evaluated in Town05, which it has
not seen. All arms start from the same head and train for equally many steps: `foredrive bench sets-training`.
"""

import functools
import tempfile
from pathlib import Path

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.detection import DetectionSample, DetectionSplit, compare_losses, detection_samples
from foredrive.scene import VoxelSpec
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.recorder import LabelOptions, record
from foredrive.towns.sensing.capture import SensorSuite

SPEC = VoxelSpec(lower_m=(-32.0, -32.0, -1.0), voxel_m=1.0, shape_zyx=(4, 64, 64))
TRAIN, CALIBRATE, TEST = ("Town01", "Town02", "Town03", "Town04", "Town10HD"), ("Town07",), ("Town05",)
TRAIN_SEEDS, CALIBRATE_SEEDS, TEST_SEEDS = (0, 1), (0, 1), (0, 1, 2, 3)
SECONDS, RATE_HZ = 30.0, 2.0
STEPS = {"first_steps": 300, "more_steps": 150}
IMAGE_HW = (16, 28)
"""Size of the images, which are not used."""


@functools.cache
def split() -> DetectionSplit:
    """Return the samples of the drives of each town, one drive for each seed."""
    return DetectionSplit(
        samples(TRAIN, TRAIN_SEEDS), samples(CALIBRATE, CALIBRATE_SEEDS), samples(TEST, TEST_SEEDS)
    )


def samples(towns: tuple[str, ...], seeds: tuple[int, ...]) -> list[DetectionSample]:
    sensors = SensorSuite(camera_rig(IMAGE_HW), roof_lidar())
    labels = LabelOptions(occupancy=None, visibility=False, captions=False)
    with tempfile.TemporaryDirectory() as folder:
        return [
            sample
            for town in towns
            for seed in seeds
            for sample in detection_samples(
                record(town, SECONDS, seed, Path(folder), rate_hz=RATE_HZ, sensors=sensors, labels=labels),
                SPEC,
            )
        ]


BENCHMARK = Benchmark(
    question="What does training by set likelihood do to likelihood, calibration and mAP?",
    arms=compare_losses(split, SPEC, **STEPS),
    config={
        "train": TRAIN,
        "calibrate": CALIBRATE,
        "test": TEST,
        "drives_of_a_town": {"train": TRAIN_SEEDS, "calibrate": CALIBRATE_SEEDS, "test": TEST_SEEDS},
        "seconds": SECONDS,
        "rate_hz": RATE_HZ,
        **STEPS,
    },
)
