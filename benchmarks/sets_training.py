"""What the likelihood of sets does to a detector: trained by matching, then by it, then calibrated.

A detection head on a volume of lidar hits learns from drives in towns and is judged in Town05, which it has
not seen. Both arms that are trained go on from the same head for equally many steps:
`foredrive bench sets-training`.
"""

import functools
import tempfile
from pathlib import Path

from benchmarks.common.detection import DetectionSample, DetectionSplit, compare_losses, detection_samples
from foredrive.evaluation import Benchmark
from foredrive.runs.demo import camera_rig, roof_lidar
from foredrive.scene import VoxelSpec
from foredrive.towns.recorder import LabelKinds, record
from foredrive.towns.sensing.capture import SensorSuite

SPEC = VoxelSpec(lower_m=(-32.0, -32.0, -1.0), voxel_m=1.0, shape_zyx=(4, 64, 64))
TRAIN, CALIBRATE, TEST = ("Town01", "Town02", "Town03", "Town04", "Town10HD"), ("Town07",), ("Town05",)
TRAIN_SEEDS, CALIBRATE_SEEDS, TEST_SEEDS = (0, 1), (0, 1), (0, 1, 2, 3)
SECONDS, RATE_HZ = 30.0, 2.0
STEPS = {"first_steps": 500, "more_steps": 250}
IMAGE_HW = (16, 28)
"""Nothing looks at the images."""


@functools.cache
def split() -> DetectionSplit:
    """The drives of each town, one for each seed."""
    return DetectionSplit(
        samples(TRAIN, TRAIN_SEEDS), samples(CALIBRATE, CALIBRATE_SEEDS), samples(TEST, TEST_SEEDS)
    )


def samples(towns: tuple[str, ...], seeds: tuple[int, ...]) -> list[DetectionSample]:
    sensors = SensorSuite(camera_rig(IMAGE_HW), roof_lidar())
    labels = LabelKinds(occupancy=None, visibility=False, captions=False)
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
