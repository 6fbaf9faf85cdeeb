"""Scores of frames: set likelihood, its parts, and matches of detections with objects."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.sets import PoissonMultiBernoulli, SetNll, UniformPoisson, set_nll
from foredrive.tasks.detection.frames import DetectionFrame, DetectionSet
from foredrive.tasks.detection.gospa import Gospa, gospa, wasserstein_distance
from foredrive.tasks.detection.pdq import PdqCounts, count_pdq, pixel_quality
from foredrive.tasks.detection.proper_scores import object_brier
from foredrive.tasks.objects.matching import (
    COCO_OVERLAPS,
    NUSCENES_DISTANCES_M,
    descending,
    match_greedily,
    overlaps,
)

PARTS = ("localisation", "classification", "false", "missed", "expected_background", "ambiguity")
NEAR_M, NEAR_OVERLAP = (1.0, 2.0), (0.5, 0.75)
"""Detections near an object, for object-level calibration."""
GOSPA_CUTOFF_M, GOSPA_CUTOFF_PX = 2.0, 50.0
GOSPA_CONFIDENCE = 0.5
"""GOSPA has no probabilities: detections below this one are left out of it."""


@dataclass(frozen=True)
class ScoreConfig:
    """Options of the likelihood of a file of detections."""

    background_rate: float = 1.0
    """Expected number of further objects a frame, uniform over the truth's classes and the frame's region.
    With 0, as in Paper A, the NLL is infinite where nothing explains an object."""
    low_confidence: float = 0.1
    """Detections of no more confidence become the Poisson background (Paper A)."""
    k: int = 25
    """Number of best associations to sum if there are too many to sum all."""


@dataclass(frozen=True)
class ObjectScores:
    """Costs of each object of a frame, in nats, expected over associations."""

    label: Int[ndarray, "N"]
    localisation: Float[ndarray, "N"]
    classification: Float[ndarray, "N"]
    missed: Float[ndarray, "N"]
    missed_probability: Float[ndarray, "N"]
    best: Int[ndarray, "N"]
    """Index of the likeliest detection among the frame's `detected`; -1: background."""
    brier: Float[ndarray, "N"]
    """`object_brier` of detections that are not background, mean over thresholds of nearness."""


@dataclass(frozen=True)
class DetectionScores:
    """Scores and matches of each detection of a frame."""

    label: Int[ndarray, "M"]
    """Likeliest class."""
    score: Float[ndarray, "M"]
    """Existence times the probability of that class."""
    existence: Float[ndarray, "M"]
    has_object: Float[ndarray, "M"]
    """Probability that it has an object; NaN for background."""
    hit: Bool[ndarray, "T M"]
    """Whether it hits an object at each threshold of average precision, by greedy matching."""
    overlap: Float[ndarray, "M"]
    """Overlap with the object that it hits, else 0; NaN for 3-D boxes."""


@dataclass(frozen=True)
class PrecisionScores:
    """Detections and objects that average precision counts."""

    label: Int[ndarray, "m"]
    score: Float[ndarray, "m"]
    hit: Bool[ndarray, "T m"]
    """True where the detection hits an object at a threshold, by greedy matching among the counted ones."""
    true_label: Int[ndarray, "n"]


@dataclass(frozen=True)
class FrameScore:
    """The likelihood of one frame and its parts."""

    name: str
    sequence: str
    nll: float
    """+inf where an object or a certain detection is impossible."""
    gap: float
    """Upper bound on how far the true value lies below `nll`."""
    parts: dict[str, float]
    gospa: Gospa
    pgospa: Gospa
    detections: DetectionScores
    precision: PrecisionScores
    objects: ObjectScores
    pdq: PdqCounts | None
    """None for 3-D boxes."""


def score_frames(
    detection_set: DetectionSet,
    config: ScoreConfig = ScoreConfig(),
    *,
    on_frame: Callable[[int], None] | None = None,
) -> list[FrameScore]:
    """Score every frame. `on_frame` is called with the number of frames that are done."""
    scores = []
    with torch.no_grad():
        for done, frame in enumerate(detection_set.frames, 1):
            scores.append(_score_frame(frame, detection_set, config))
            if on_frame is not None:
                on_frame(done)
    return scores


def predicted_set(
    frame: DetectionFrame, classes: int, true_classes: int, config: ScoreConfig
) -> PoissonMultiBernoulli:
    """Return a frame's detections as a PMB. Its background has those of low confidence and a uniform process.

    The uniform process has the first `true_classes` alone. Classes that only a detector names do not change
    it.
    """
    if config.background_rate == 0:
        return PoissonMultiBernoulli.from_detections(frame.detected, config.low_confidence)
    # The background rate is shared evenly by the classes of the truth
    rate = torch.zeros(classes, dtype=torch.float64)
    rate[:true_classes] = config.background_rate / true_classes
    uniform = UniformPoisson(
        rate,
        torch.as_tensor(frame.lower),
        torch.as_tensor(frame.upper),
        frame.objects.yaw is not None,
    )
    return PoissonMultiBernoulli.from_detections(frame.detected, config.low_confidence, uniform)


def _score_frame(frame: DetectionFrame, detection_set: DetectionSet, config: ScoreConfig) -> FrameScore:
    is_3d = detection_set.is_3d
    pmb = predicted_set(frame, len(detection_set.classes), detection_set.true_classes, config)
    result = set_nll(pmb, frame.objects, k=config.k)
    # The other detections are background, and have no association
    bernoulli = np.flatnonzero(frame.detected.log_existence.numpy() > np.log(config.low_confidence))
    closeness = _closeness(frame, is_3d)
    detections = _detections(frame, result, bernoulli, closeness, is_3d)
    brier = _object_brier(frame, bernoulli, closeness, is_3d)
    return FrameScore(
        frame.name,
        frame.sequence,
        float(result.nll),
        # Upper minus lower bound of the NLL if not all associations are summed
        float(result.nll) - result.lower if result.nll.isfinite() else 0.0,
        {part: float(getattr(result, part)) for part in PARTS},
        *_gospas(frame, detections, is_3d),
        detections,
        _precision(frame, detections, closeness, is_3d),
        _objects(frame, result, bernoulli, brier),
        None if is_3d else _pdq(frame, detections),
    )


def _pdq(frame: DetectionFrame, detections: DetectionScores) -> PdqCounts:
    """Count pairs for PDQ. Label quality is existence times class probability."""
    boxes = frame.detected.boxes
    # Standard deviation of each edge: root of the diagonal of L Lᵀ
    std = boxes.chol.square().sum(-1).sqrt().numpy()
    share = detections.existence[:, None] * frame.detected.log_class.exp().numpy()
    true = frame.objects
    return count_pdq(pixel_quality(boxes.mean.numpy(), std, share, true.state.numpy(), true.label.numpy()))


def _objects(
    frame: DetectionFrame,
    result: SetNll,
    bernoulli: Int[ndarray, "_"],
    brier: Float[ndarray, "N"],
) -> ObjectScores:
    associations, count = result.associations, len(result.associations.background)
    # Expected cost over associations: probability of each pair times its negative log-likelihood
    box = -associations.probability * result.pair_log_box.numpy()
    label = -associations.probability * result.pair_log_label.numpy()
    log_background = result.log_background.numpy()
    # 0 · -inf is NaN: an object that is never missed has no cost
    with np.errstate(invalid="ignore"):
        missed = np.where(associations.background > 0, -associations.background * log_background, 0.0)
    return ObjectScores(
        frame.objects.label.numpy(),
        np.bincount(associations.object, box, count).astype(float),  # bincount of no pairs returns integers
        np.bincount(associations.object, label, count).astype(float),
        missed,
        associations.background,
        # Index among all detections; -1 stays background
        np.where(associations.best < 0, -1, np.append(bernoulli, -1)[associations.best]),
        brier,
    )


def _object_brier(
    frame: DetectionFrame, bernoulli: Int[ndarray, "_"], closeness: Float[ndarray, "M N"], is_3d: bool
) -> Float[ndarray, "N"]:
    detected, label = frame.detected, frame.objects.label.numpy()
    # Probability of existence with each class
    probability = (detected.log_existence[:, None] + detected.log_class).exp().numpy()[bernoulli]
    # Closeness is minus the distance, or the overlap
    thresholds = [-distance for distance in NEAR_M] if is_3d else NEAR_OVERLAP
    briers = [object_brier(probability, closeness[bernoulli] >= nearness, label) for nearness in thresholds]
    return np.mean(briers, axis=0)


def _detections(
    frame: DetectionFrame,
    result: SetNll,
    bernoulli: Int[ndarray, "_"],
    closeness: Float[ndarray, "M N"],
    is_3d: bool,
) -> DetectionScores:
    detected, objects = frame.detected, frame.objects
    label = detected.log_class.argmax(-1).numpy()
    score = (detected.log_existence + detected.log_class.amax(-1)).exp().numpy()
    has_object = np.full(len(label), np.nan)
    # The posterior probability that no object belongs to a detection
    has_object[bernoulli] = 1.0 - result.associations.absent
    true, overlap = objects.label.numpy(), np.full(len(label), np.nan if is_3d else 0.0)
    # Only objects of the same class can be hit
    near = np.where(label[:, None] == true, closeness, -np.inf)
    if not is_3d:
        # Any overlap above 0 is a match here
        taken = match_greedily(descending(score), near, np.nextafter(0.0, 1.0))
        which = np.flatnonzero(taken >= 0)
        overlap[which] = near[which, taken[which]]
    existence = detected.log_existence.exp().numpy()
    return DetectionScores(label, score, existence, has_object, _hits(score, near, is_3d), overlap)


def _precision(
    frame: DetectionFrame, detections: DetectionScores, closeness: Float[ndarray, "M N"], is_3d: bool
) -> PrecisionScores:
    """Match the detections and objects that average precision counts, by the file's labels and scores."""
    label, score, true = detections.label, detections.score, frame.objects.label.numpy()
    counts = frame.object_counts
    # Average precision reads the file's own labels and scores, and only what the protocol counts
    if frame.stated is not None:
        which = np.flatnonzero(frame.stated.counts)
        label, score, closeness = frame.stated.label[which], frame.stated.score[which], closeness[which]
    if counts is not None:
        true, closeness = true[counts], closeness[:, counts]
    near = np.where(label[:, None] == true, closeness, -np.inf)
    return PrecisionScores(label, score, _hits(score, near, is_3d), true)


def _hits(score: Float[ndarray, "m"], near: Float[ndarray, "m n"], is_3d: bool) -> Bool[ndarray, "T m"]:
    """Return whether each detection hits an object, at each distance (nuScenes) or overlap (COCO)."""
    order = descending(score, ties_reversed=is_3d)
    # nuScenes asks for a distance below the threshold, COCO for an overlap of at least the threshold
    thresholds = [np.nextafter(-d, 0.0) for d in NUSCENES_DISTANCES_M] if is_3d else COCO_OVERLAPS
    return np.array([match_greedily(order, near, threshold) >= 0 for threshold in thresholds])


def _closeness(frame: DetectionFrame, is_3d: bool) -> Float[ndarray, "M N"]:
    """Return minus the distance of centres over ground in m, or the overlap."""
    mean, state = frame.detected.boxes.mean.numpy(), frame.objects.state.numpy()
    if not is_3d:
        return overlaps(mean, state)
    return -np.linalg.norm(mean[:, None, :2] - state[:, :2], axis=-1)


def _gospas(frame: DetectionFrame, detections: DetectionScores, is_3d: bool) -> tuple[Gospa, Gospa]:
    """Return GOSPA of detections above a half, and P-GOSPA of all. Likeliest classes must agree."""
    dims, cutoff = (3, GOSPA_CUTOFF_M) if is_3d else (4, GOSPA_CUTOFF_PX)
    boxes, objects = frame.detected.boxes, frame.objects
    # Pairs of different classes are impossible
    same = detections.label[:, None] == objects.label.numpy()
    apart = np.linalg.norm(boxes.mean.numpy()[:, None, :dims] - objects.state.numpy()[:, :dims], axis=-1)
    # GOSPA knows no probabilities: unlikely detections are left out
    likely = detections.score >= GOSPA_CONFIDENCE
    spread = wasserstein_distance(boxes, objects, dims)
    return (
        gospa(np.where(same, apart, np.inf)[likely], cutoff),
        gospa(np.where(same, spread, np.inf), cutoff, existence=detections.existence),
    )
