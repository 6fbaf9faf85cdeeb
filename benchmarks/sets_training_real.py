"""The same as sets-training on a real log: PandaSet 002, whose first frames teach and whose last ones judge.

One log of 5.5 s: the same street and mostly the same objects in training and judgement. It says whether the
head and its losses work on a real Pandar64 and real boxes, not how they generalise.
`foredrive bench sets-training-real`, with the raw log in FOREDRIVE_REAL_DATA/pandaset.
"""

import functools
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch

from foredrive.data.convert import convert
from foredrive.errors import InputError
from foredrive.evaluation import Benchmark
from foredrive.models.detection import DetectionHead
from foredrive.recipes.detection import CLASSES, DetectionSample, detection_samples, judge, unexplained
from foredrive.scene import VoxelSpec
from foredrive.sets import fit_set_calibration
from foredrive.training.detection import Loss, fit_head, matching_loss, said_of, set_loss

SPEC = VoxelSpec(lower_m=(-32.0, -32.0, -1.0), voxel_m=1.0, shape_zyx=(4, 64, 64))
STRIDE_S, TRAIN_S, CALIBRATE_S = 0.1, 2.8, 0.7
FIRST_STEPS, MORE_STEPS, BATCH, LEARNING_RATE = 250, 125, 8, 1e-3


@functools.cache
def samples() -> tuple[list[DetectionSample], list[DetectionSample], list[DetectionSample]]:
    """To train, to calibrate and to judge by, one after the other in time."""
    source = Path(os.environ.get("FOREDRIVE_REAL_DATA", "../shared/data")) / "pandaset"
    if not source.is_dir():
        raise InputError(f"{source}: no raw PandaSet logs here; name their parent in FOREDRIVE_REAL_DATA")
    with tempfile.TemporaryDirectory() as folder:
        (log,) = convert(source, "pandaset", Path(folder))
        found = detection_samples(log, SPEC, stride_s=STRIDE_S)
    end = round(TRAIN_S / STRIDE_S)
    later = end + round(CALIBRATE_S / STRIDE_S)
    return found[:end], found[end:later], found[later:]


def train(head: DetectionHead, loss: Loss, steps: int, seed: int) -> DetectionHead:
    torch.set_num_threads(1)
    data = [sample[:2] for sample in samples()[0]]
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


def measured(loss: Loss, *, calibrated: bool) -> Callable[[int], dict[str, float]]:
    """In the last frames; existence and covariances mended by those before, if asked for."""

    def measure(seed: int) -> dict[str, float]:
        head, (_, apart, test) = trained(loss, seed), samples()
        said = said_of(head, [s.volume for s in test])
        if calibrated:
            before = said_of(head, [s.volume for s in apart])
            mend = fit_set_calibration(before, [s.objects for s in apart], unexplained(SPEC))
            said = [mend(found) for found in said]
        return {**judge(said, test, SPEC), "frames": len(test)}

    return measure


BENCHMARK = Benchmark(
    question="On one real log: what does training by set likelihood do to likelihood, calibration and mAP?",
    arms={
        "matching": measured(matching_loss, calibrated=False),
        "mb_nll": measured(set_loss, calibrated=False),
        "matching_calibrated": measured(matching_loss, calibrated=True),
        "mb_nll_calibrated": measured(set_loss, calibrated=True),
    },
    config={
        "log": "PandaSet 002", "stride_s": STRIDE_S, "train_s": TRAIN_S, "calibrate_s": CALIBRATE_S,
        "first_steps": FIRST_STEPS, "more_steps": MORE_STEPS, "batch": BATCH, "rate": LEARNING_RATE,
    },
)  # fmt: skip
