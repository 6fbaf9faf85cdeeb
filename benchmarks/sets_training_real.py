"""The same as sets-training on a real log, PandaSet 002: the first frames train, the last ones test.

The log lasts 5.5 s: training and testing have the same street and mostly the same objects. It shows whether
the head and its losses work on a real Pandar64 and real boxes, not how they generalise. `foredrive bench
sets-training-real`, with the raw log in FOREDRIVE_REAL_DATA/pandaset.
"""

import functools
import tempfile
from pathlib import Path

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.detection import DetectionSplit, compare_losses, detection_samples
from benchmarks.common.study import pandaset_log
from foredrive.scene import VoxelSpec

SPEC = VoxelSpec(lower_m=(-32.0, -32.0, -1.0), voxel_m=1.0, shape_zyx=(4, 64, 64))
STRIDE_S, TRAIN_S, CALIBRATE_S = 0.1, 2.8, 0.7
STEPS = {"first_steps": 250, "more_steps": 125}


@functools.cache
def split() -> DetectionSplit:
    """Split the samples of the log by time."""
    with tempfile.TemporaryDirectory() as folder:
        log = pandaset_log(Path(folder) / "pandaset")
        found = detection_samples(log, SPEC, stride_s=STRIDE_S)
    end = round(TRAIN_S / STRIDE_S)
    later = end + round(CALIBRATE_S / STRIDE_S)
    return DetectionSplit(found[:end], found[end:later], found[later:])


BENCHMARK = Benchmark(
    question="On one real log: what does training by set likelihood do to likelihood, calibration and mAP?",
    arms=compare_losses(split, SPEC, **STEPS),
    config={
        "log": "PandaSet 002",
        "stride_s": STRIDE_S,
        "train_s": TRAIN_S,
        "calibrate_s": CALIBRATE_S,
        **STEPS,
    },
)
