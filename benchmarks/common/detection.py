"""The detection task: samples from any log, metrics of a head on them, and a comparison of losses.

`heads.detection_training.fit_head` trains a head (`heads.detection_network`) on samples; docs/sets.md shows
how.
"""

import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.data import ClipConfig, ClipDataset, LogPath
from foredrive.geometry.boxes import points_in_boxes
from foredrive.heads.detection_losses import Loss, MatchingLossConfig, matching_loss, set_loss
from foredrive.heads.detection_network import DetectionHead
from foredrive.heads.detection_training import Sample, fit_head, predict_sets
from foredrive.scene import Category, Clip, LidarSweep, VoxelSpec, WorldModel
from foredrive.sets import Family, LabelledBoxes, MultiBernoulli, UniformPoisson, fit_set_calibration
from foredrive.tasks.detection.frames import DetectionFrame, DetectionSet
from foredrive.tasks.detection.score import score_frames
from foredrive.tasks.detection.summary import summarise_scores

CLASSES = ("vehicle", "cycle", "pedestrian")
_CLASS_OF = {
    **dict.fromkeys((Category.CAR, Category.TRUCK, Category.BUS, Category.TRAILER), 0),
    **dict.fromkeys((Category.BICYCLE, Category.MOTORCYCLE), 1),
    Category.PEDESTRIAN: 2,
}
MIN_HITS = 3
"""Minimum number of lidar hits of an object; objects with fewer are left out."""
_IMAGE_HW = (16, 28)
"""Size of the images, which are not used."""
HALF_HEIGHT_M, LARGEST_LOG_SIZE = 5.0, 4.0
"""Bounds of the region of undetected objects: half height (m) and size (logarithm)."""


class DetectionSample(NamedTuple):
    """One moment of a log."""

    volume: Float[Tensor, "D Z Y X"]
    objects: LabelledBoxes
    log: str


class DetectionSplit(NamedTuple):
    """Samples for training, calibration and testing."""

    train: Sequence[DetectionSample]
    calibrate: Sequence[DetectionSample]
    test: Sequence[DetectionSample]


def detection_samples(log: LogPath, spec: VoxelSpec, *, stride_s: float = 0.5) -> list[DetectionSample]:
    """Return lidar hits and objects every `stride_s` of a log with lidar and boxes."""

    def volume_of(clip: Clip) -> Float[Tensor, "1 Z Y X"]:
        return hits_volume(clip.sweeps[clip.now], spec)

    config = ClipConfig(
        past_frames=0, future_frames=0, image_hw=_IMAGE_HW, voxels=spec, horizon_steps=1, lidar=True,
        now_stride_s=stride_s,
    )  # fmt: skip
    return _samples(log, config, volume_of)


def observed_samples(
    log: LogPath, world_model: WorldModel, clips: ClipConfig, *, stride_s: float = 0.5
) -> list[DetectionSample]:
    """Return a world model's volumes of a log's images, and the objects hit by its lidar, every `stride_s`.

    `clips` are those of the model's recipe; the model is not trained.
    """
    config = dataclasses.replace(clips, future_frames=0, lidar=True, now_stride_s=stride_s)

    def volume_of(clip: Clip) -> Float[Tensor, "D Z Y X"]:
        with torch.no_grad():
            return world_model.observe(clip.map_tensors(lambda tensor: tensor[None]).observed()).volume[0]

    return _samples(log, config, volume_of)


def _samples(
    log: LogPath, config: ClipConfig, volume_of: Callable[[Clip], Float[Tensor, "D Z Y X"]]
) -> list[DetectionSample]:
    dataset = ClipDataset([log], config, cache_dir=None)
    clips = map(dataset.clip, range(len(dataset)))
    return [DetectionSample(volume_of(clip), objects_of(clip, config.voxels), log.name) for clip in clips]


def hits_volume(sweep: LidarSweep, spec: VoxelSpec) -> Float[Tensor, "1 Z Y X"]:
    """Return log(1 + number of hits) of each voxel."""
    points = sweep.points_ego[sweep.returned & sweep.valid]
    index = ((points - torch.tensor(spec.lower_m)) / spec.voxel_m).floor().long()
    depth, height, breadth = spec.shape_zyx
    index = index[((index >= 0) & (index < torch.tensor([breadth, height, depth]))).all(-1)]
    flat = (index[:, 2] * height + index[:, 1]) * breadth + index[:, 0]
    count = torch.bincount(flat, minlength=depth * height * breadth)
    return torch.log1p(count.float()).view(1, depth, height, breadth)


def objects_of(clip: Clip, spec: VoxelSpec) -> LabelledBoxes:
    """Return the objects of one clip at now: of a known class, over the volume's ground area, hit by
    lidar.
    """
    sweep, boxes = clip.sweeps[clip.now], clip.boxes[clip.now]
    points = sweep.points_ego[sweep.returned & sweep.valid]
    hits = points_in_boxes(points, boxes.centre, boxes.size_lwh, boxes.yaw).sum(0)
    lower, upper = _ground(spec)
    inside = ((boxes.centre[:, :2] > lower) & (boxes.centre[:, :2] < upper)).all(-1)
    label = torch.tensor([_CLASS_OF.get(Category(int(c)), -1) for c in boxes.category])
    keep = boxes.valid & inside & (hits >= MIN_HITS) & (label >= 0)
    kept = boxes[keep]
    return LabelledBoxes(label[keep], torch.cat([kept.centre, kept.size_lwh.log()], dim=-1), kept.yaw)


def uniform_background(spec: VoxelSpec) -> UniformPoisson:
    """Return a prior of one undetected object per frame, uniform over classes and the ground area."""
    lower, upper = _ground(spec)
    rest = torch.tensor([HALF_HEIGHT_M, *[LARGEST_LOG_SIZE] * 3])
    rate = torch.full((len(CLASSES),), 1 / len(CLASSES))
    region = torch.cat([lower, -rest]).double(), torch.cat([upper, rest]).double()
    return UniformPoisson(rate, *region, has_yaw=True)


def evaluate(
    detected: Sequence[MultiBernoulli], samples: Sequence[DetectionSample], spec: VoxelSpec
) -> dict[str, float]:
    """Return the metrics of `foredrive score`: likelihood, its parts, mAP, calibration; NaN for none."""
    region = uniform_background(spec)
    frames = [
        DetectionFrame(f"{n}", sample.log, found, sample.objects, region.lower.numpy(), region.upper.numpy())
        for n, (found, sample) in enumerate(zip(detected, samples, strict=True))
    ]
    read = DetectionSet(frames, CLASSES, True, {}, len(CLASSES))
    summary = summarise_scores(read, score_frames(read)).figures
    names = {
        "pmb_nll.mean": "pmb_nll", "map": "map", "calibration.d_ece": "d_ece", "brier.hit": "brier",
        "calibration.existence": "existence_error", "calibration.object_level": "object_level_error",
        "std.best_factor": "std_best_factor", "pgospa.distance": "pgospa_m", "objects": "objects",
        "pmb_nll.frames_infinite": "frames_infinite",
    }  # fmt: skip
    parts = ("localisation", "classification", "false", "missed", "expected_background", "ambiguity")
    names |= {f"pmb_nll.{part}": f"pmb_nll_{part}" for part in parts}
    found = {short: summary.get(key) for key, short in names.items()}
    return {short: math.nan if value is None else float(value) for short, value in found.items()}


class _Arm(NamedTuple):
    loss: Loss
    family: Family = "gaussian"


ARMS = {
    "matching": _Arm(matching_loss),
    "matching_laplace": _Arm(matching_loss, "laplace"),
    "energy": _Arm(functools.partial(matching_loss, config=MatchingLossConfig(box_score="energy"))),
    "mb_nll": _Arm(set_loss),
    "mb_nll_laplace": _Arm(set_loss, "laplace"),
}
"""Loss of the last steps of training, and family of the box densities that it trains."""


def compare_losses(
    split: Callable[[], DetectionSplit], spec: VoxelSpec, *, first_steps: int, more_steps: int
) -> dict[str, Callable[[int], dict[str, float]]]:
    """Return the arms of a benchmark as functions from seed to metrics: `ARMS`, and each calibrated.

    All heads of a seed start from the same head, trained by Gaussian matching, and train for equally many
    steps. `split` is called whenever samples are needed.
    """

    def samples() -> list[Sample]:
        return [sample[:2] for sample in split().train]

    @functools.cache
    def first(seed: int) -> DetectionHead:
        torch.manual_seed(seed)
        data = samples()
        head = DetectionHead(spec, channels=len(data[0][0]), classes=len(CLASSES))
        return fit_head(head, data, matching_loss, steps=first_steps, seed=seed)

    @functools.cache
    def trained(name: str, seed: int) -> DetectionHead:
        loss, family = ARMS[name]
        head = copy.deepcopy(first(seed))
        head.family = family
        return fit_head(head, samples(), loss, steps=more_steps, seed=seed + 100)

    def measure(name: str, calibrated: bool, seed: int) -> dict[str, float]:
        torch.set_num_threads(1)
        head, (_, apart, test) = trained(name, seed), split()
        predicted = predict_sets(head, [sample.volume for sample in test])
        if calibrated:
            before = predict_sets(head, [sample.volume for sample in apart])
            calibrate = fit_set_calibration(
                before, [sample.objects for sample in apart], uniform_background(spec)
            )
            predicted = [calibrate(found) for found in predicted]
        return {**evaluate(predicted, test, spec), "frames": float(len(test))}

    return {
        name + ("_calibrated" if calibrated else ""): functools.partial(measure, name, calibrated)
        for calibrated in (False, True)
        for name in ARMS
    }


def _ground(spec: VoxelSpec) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    lower = torch.tensor(spec.lower_m[:2])
    return lower, lower + spec.voxel_m * torch.tensor([spec.shape_zyx[2], spec.shape_zyx[1]])
