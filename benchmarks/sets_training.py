"""What the likelihood of sets does to a detector: trained by matching, then by it, then calibrated.

A detection head on a volume of lidar hits learns from drives in towns and is judged in Town05, which it has
not seen. Both arms that are trained go on from the same head for equally many steps:
`foredrive bench sets-training`.
"""

import copy
import dataclasses
import functools
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from foredrive.data import ClipConfig, ClipDataset, LogPath
from foredrive.evaluation import Benchmark
from foredrive.evaluation.detections import DetectionSet, Frame, FrameScore, score_frames, summarise_scores
from foredrive.geometry.boxes import points_in_boxes
from foredrive.models.detection import BoxSet, DetectionHead
from foredrive.recipes.demo import camera_rig, roof_lidar
from foredrive.scene import Category, LidarSweep, VoxelSpec
from foredrive.sets import (
    BoxDensity,
    LabelledBoxes,
    MultiBernoulli,
    PoissonMultiBernoulli,
    UniformPoisson,
    fit_existence,
    fit_scale,
    set_nll,
)
from foredrive.towns.recorder import LabelKinds, record
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.training.detection import as_multi_bernoulli, matching_loss, set_loss

SPEC = VoxelSpec(lower_m=(-32.0, -32.0, -1.0), voxel_m=1.0, shape_zyx=(4, 64, 64))
CLASSES = ("vehicle", "cycle", "pedestrian")
CLASS_OF = {
    **dict.fromkeys((Category.CAR, Category.TRUCK, Category.BUS, Category.TRAILER), 0),
    **dict.fromkeys((Category.BICYCLE, Category.MOTORCYCLE), 1),
    Category.PEDESTRIAN: 2,
}
TRAIN, CALIBRATE, TEST = ("Town01", "Town02", "Town03", "Town04", "Town10HD"), ("Town07",), ("Town05",)
SECONDS, RATE_HZ, LEAST_HITS = 30.0, 2.0, 3
FIRST_STEPS, MORE_STEPS, BATCH, LEARNING_RATE = 500, 250, 8, 1e-3
IMAGE_HW = (16, 28)
"""Nothing looks at the images."""

UPPER = np.array([32.0, 32.0, 5.0, 4.0, 4.0, 4.0])
UNEXPLAINED = UniformPoisson(
    torch.full((len(CLASSES),), 1 / len(CLASSES)), torch.as_tensor(-UPPER), torch.as_tensor(UPPER), True
)

Sample = tuple[torch.Tensor, LabelledBoxes]
Loss = Callable[[BoxSet, LabelledBoxes], torch.Tensor]


@functools.cache
def samples(towns: tuple[str, ...]) -> tuple[list[Sample], list[str]]:
    """Volumes and objects of each town's drive, and which drive they are of."""
    sensors = SensorSuite(camera_rig(IMAGE_HW), roof_lidar())
    labels = LabelKinds(occupancy=None, visibility=False, captions=False)
    clips = ClipConfig(
        past_frames=0, future_frames=0, image_hw=IMAGE_HW, voxels=SPEC, horizon_steps=1, lidar=True
    )
    found: list[Sample] = []
    drives: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for town in towns:
            log: LogPath = record(
                town, SECONDS, 0, Path(folder), rate_hz=RATE_HZ, sensors=sensors, labels=labels
            )
            data = ClipDataset([log], clips, Path(folder, "cache"))
            for index in range(len(data)):
                clip = data[index].clip
                sweep, boxes = clip.sweeps[clip.now], clip.boxes[clip.now]
                points = sweep.points_ego[sweep.returned & sweep.valid]
                hits = points_in_boxes(points, boxes.centre, boxes.size_lwh, boxes.yaw).sum(0)
                inside = (boxes.centre[:, :2].abs() < -SPEC.lower_m[0]).all(-1)
                label = torch.tensor([CLASS_OF.get(Category(int(c)), -1) for c in boxes.category])
                keep = boxes.valid & inside & (hits >= LEAST_HITS) & (label >= 0)
                kept = boxes[keep]
                state = torch.cat([kept.centre, kept.size_lwh.log()], dim=-1)
                found.append((volume_of(sweep), LabelledBoxes(label[keep], state, kept.yaw)))
                drives.append(log.name)
    return found, drives


def volume_of(sweep: LidarSweep) -> torch.Tensor:
    """Logarithm of the hits in each voxel, [1 Z Y X]."""
    points = sweep.points_ego[sweep.returned & sweep.valid]
    index = ((points - torch.tensor(SPEC.lower_m)) / SPEC.voxel_m).floor().long()
    depth, height, breadth = SPEC.shape_zyx
    index = index[((index >= 0) & (index < torch.tensor([breadth, height, depth]))).all(-1)]
    flat = (index[:, 2] * height + index[:, 1]) * breadth + index[:, 0]
    count = torch.bincount(flat, minlength=depth * height * breadth)
    return torch.log1p(count.float()).view(1, depth, height, breadth)


def train(head: DetectionHead, loss: Loss, steps: int, seed: int) -> DetectionHead:
    """Go on for some steps; the learning rate falls to nothing."""
    torch.set_num_threads(1)
    head = copy.deepcopy(head)
    data, _ = samples(TRAIN)
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.AdamW(head.parameters(), LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps)
    for _ in range(steps):
        chosen = [data[n] for n in rng.choice(len(data), BATCH, replace=False)]
        optimizer.zero_grad()
        found = head(torch.stack([volume for volume, _ in chosen]))
        torch.stack([loss(found[n], truth) for n, (_, truth) in enumerate(chosen)]).mean().backward()
        torch.nn.utils.clip_grad_norm_(head.parameters(), 10.0)
        optimizer.step()
        schedule.step()
    return head


@functools.cache
def first(seed: int) -> DetectionHead:
    """The head that all arms go on from."""
    torch.manual_seed(seed)
    head = DetectionHead(SPEC, channels=1, classes=len(CLASSES))
    return train(head, matching_loss, FIRST_STEPS, seed)


@functools.cache
def trained(loss: Loss, seed: int) -> DetectionHead:
    """The head after more steps with a loss."""
    return train(first(seed), loss, MORE_STEPS, seed + 100)


def said(head: DetectionHead, towns: tuple[str, ...]) -> list[MultiBernoulli]:
    """Of each frame, float64."""
    with torch.no_grad():
        return [
            as_multi_bernoulli(head(volume[None])[0].map_tensors(torch.Tensor.double))
            for volume, _ in samples(towns)[0]
        ]


def scored(detected: list[MultiBernoulli], towns: tuple[str, ...]) -> tuple[DetectionSet, list[FrameScore]]:
    """As `foredrive score` does it."""
    found, drives = samples(towns)
    frames = [
        Frame(f"{n}", drives[n], detected[n], truth, -UPPER, UPPER) for n, (_, truth) in enumerate(found)
    ]
    read = DetectionSet(frames, CLASSES, True, {})
    return read, score_frames(read)


def figures(detected: list[MultiBernoulli]) -> dict[str, float]:
    """In the town that was held out."""
    read, scores = scored(detected, TEST)
    summary = summarise_scores(read, scores).figures
    names = {
        "pmb_nll.mean": "pmb_nll", "map": "map", "calibration.d_ece": "d_ece", "brier.hit": "brier",
        "calibration.existence": "existence_error", "std.best_factor": "std_best_factor",
        "pgospa.distance": "pgospa_m", "objects": "objects", "pmb_nll.frames_infinite": "frames_infinite",
    }  # fmt: skip
    parts = ("localisation", "classification", "false", "missed", "expected_background", "ambiguity")
    names |= {f"pmb_nll.{part}": f"pmb_nll_{part}" for part in parts}
    return {short: float(summary.get(key) or 0.0) for key, short in names.items()}


def matching(seed: int) -> dict[str, float]:
    return figures(said(trained(matching_loss, seed), TEST))


def likelihood(seed: int) -> dict[str, float]:
    return figures(said(trained(set_loss, seed), TEST))


def calibrated(loss: Loss) -> Callable[[int], dict[str, float]]:
    """Existence by isotonic regression and covariances by one factor, fitted in a town of its own."""

    def measure(seed: int) -> dict[str, float]:
        head = trained(loss, seed)
        existence, has_object, boxes, objects = [], [], [], []
        for found, (_, truth) in zip(said(head, CALIBRATE), samples(CALIBRATE)[0], strict=True):
            pairs = set_nll(PoissonMultiBernoulli(found, UNEXPLAINED), truth).associations
            existence.append(found.log_existence.exp().numpy())
            has_object.append(1.0 - pairs.absent)
            has = np.flatnonzero(pairs.best >= 0)
            boxes.append(found.boxes[pairs.best[has]])
            objects.append(truth[has])
        existence_map = fit_existence(np.concatenate(existence), np.concatenate(has_object))
        factor = fit_scale(
            BoxDensity(torch.cat([b.mean for b in boxes]), torch.cat([b.chol for b in boxes])),
            LabelledBoxes(torch.cat([o.label for o in objects]), torch.cat([o.state for o in objects])),
        )
        return figures([mend(found, existence_map, factor) for found in said(head, TEST)])

    return measure


def mend(found: MultiBernoulli, existence_map: Callable, factor: float) -> MultiBernoulli:
    """What is said, as it was meant."""
    r = torch.as_tensor(existence_map(found.log_existence.exp().numpy()))
    boxes = dataclasses.replace(found.boxes, chol=found.boxes.chol * factor)
    return dataclasses.replace(found, log_existence=r.log(), log_absence=torch.log1p(-r), boxes=boxes)


BENCHMARK = Benchmark(
    question="What does training by set likelihood do to likelihood, calibration and mAP?",
    arms={
        "matching": matching,
        "mb_nll": likelihood,
        "matching_calibrated": calibrated(matching_loss),
        "mb_nll_calibrated": calibrated(set_loss),
    },
    config={
        "train": TRAIN, "calibrate": CALIBRATE, "test": TEST, "seconds": SECONDS, "rate_hz": RATE_HZ,
        "first_steps": FIRST_STEPS, "more_steps": MORE_STEPS, "batch": BATCH, "rate": LEARNING_RATE,
    },
)  # fmt: skip
