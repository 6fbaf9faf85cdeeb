"""Figures over all frames: likelihood, its parts and slices, precision, calibration, proper scores."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from foredrive.engine.summary import Figures
from foredrive.errors import InputError
from foredrive.sets import BoxDensity, LabelledBoxes, conformal_factor, conformal_scores, fit_scale
from foredrive.tasks.bootstrap import BootstrapMean, bootstrap_mean
from foredrive.tasks.detection.frames import DetectionFrame, DetectionSet
from foredrive.tasks.detection.pdq import pdq
from foredrive.tasks.detection.proper_scores import brier, crps_gaussian, crps_laplace, energy_score
from foredrive.tasks.detection.reliability import Reliability, reliability
from foredrive.tasks.detection.score import PARTS, FrameScore
from foredrive.tasks.objects.matching import (
    COCO_OVERLAPS,
    NUSCENES_DISTANCES_M,
    average_precision_coco,
    average_precision_nuscenes,
    mean_of_valid,
)

LENGTHS_M = (0.0, 2.0, 6.0, np.inf)
SIDES_PX = (0.0, 32.0, 96.0, np.inf)
"""Roots of areas: COCO's small, medium and large."""
RANGES_M = (0.0, 20.0, 40.0, 60.0, np.inf)
COVERAGE = 0.9


@dataclass(frozen=True)
class ScoreSummary:
    """Flat figures and reliability diagrams."""

    figures: Figures
    diagrams: Mapping[str, Reliability]


def summarise_scores(
    detection_set: DetectionSet, scores: Sequence[FrameScore], seed: int = 0
) -> ScoreSummary:
    """Return the figures of `FIGURE_FUNCTIONS`, and the reliability diagrams.

    Likelihoods are averaged over frames where they are finite; the others are counted.
    """
    rng = np.random.default_rng(seed)
    figures: Figures = {}
    for compute in FIGURE_FUNCTIONS:
        figures |= compute(detection_set, scores, rng)
    return ScoreSummary(figures, _diagrams(detection_set, scores))


def compare_scores(
    scores: Sequence[FrameScore], others: Sequence[FrameScore], seed: int = 0
) -> tuple[BootstrapMean, int]:
    """Return the mean of ours minus theirs over frames where both are finite, and the number of the others.

    Raises:
        InputError: the frames are not the same, or none can be compared.
    """
    if [score.name for score in scores] != [other.name for other in others]:
        raise InputError("two files of detections can be compared on the same frames only")
    ours, theirs = (np.array([score.nll for score in scored]) for scored in (scores, others))
    # An infinite likelihood has no difference
    both = np.isfinite(ours) & np.isfinite(theirs)
    if not both.any():
        raise InputError("there is no frame in which both likelihoods are finite")
    sequences = np.array([score.sequence for score in scores])[both].tolist()
    compared = bootstrap_mean((ours - theirs)[both], sequences, np.random.default_rng(seed))
    # Whole sequences are resampled, as frames of one sequence resemble each other
    return compared, int((~both).sum())


def _joined(scores: Sequence[FrameScore], part: str, field: str) -> ndarray:
    return np.concatenate([getattr(getattr(score, part), field) for score in scores], axis=-1)


def _counts(detection_set: DetectionSet, scores: Sequence[FrameScore], rng: np.random.Generator) -> Figures:
    """Count frames, objects, detections, and what was assumed or missing."""
    return {
        "frames": len(scores),
        "objects": sum(len(score.objects.label) for score in scores),
        "detections": sum(len(score.detections.label) for score in scores),
        "pmb_nll.frames_infinite": int((~np.isfinite([score.nll for score in scores])).sum()),
        **detection_set.counts,
    }


def _likelihood(
    detection_set: DetectionSet, scores: Sequence[FrameScore], rng: np.random.Generator
) -> Figures:
    """Average the likelihood and its parts over frames where it is finite."""
    nll = np.array([score.nll for score in scores])
    # Parts are averaged over the same frames as the whole
    finite = np.isfinite(nll)
    if not finite.any():
        return {}
    sequences = [score.sequence for score in scores]
    interval = bootstrap_mean(nll[finite], np.array(sequences)[finite].tolist(), rng)
    figures: Figures = {
        "pmb_nll.mean": interval.mean,
        "pmb_nll.low_95": interval.low,
        "pmb_nll.high_95": interval.high,
        "pmb_nll.gap": float(np.mean([score.gap for score in scores])),
    }
    for part in PARTS:
        values = np.array([score.parts[part] for score in scores])[finite]
        figures[f"pmb_nll.{part}"] = float(values.mean())
    return figures


def _distances(
    detection_set: DetectionSet, scores: Sequence[FrameScore], rng: np.random.Generator
) -> Figures:
    """Average GOSPA and P-GOSPA, and their parts, over frames."""
    return {
        f"{name}.{part}": float(np.mean([getattr(getattr(score, name), part) for score in scores]))
        for name in ("gospa", "pgospa")
        for part in ("distance", "localisation", "existence", "missed", "false")
    }


def _precision(
    detection_set: DetectionSet, scores: Sequence[FrameScore], rng: np.random.Generator
) -> Figures:
    """Return average precision by class and threshold, as the data sets define it."""
    label, score = _joined(scores, "precision", "label"), _joined(scores, "precision", "score")
    hit, true = _joined(scores, "precision", "hit"), _joined(scores, "precision", "true_label")
    thresholds = NUSCENES_DISTANCES_M if detection_set.is_3d else COCO_OVERLAPS
    average = average_precision_nuscenes if detection_set.is_3d else average_precision_coco
    # Average precision by class and threshold
    table = np.array(
        [
            [average(score[label == c], row[label == c], int((true == c).sum())) for row in hit]
            for c in range(len(detection_set.classes))
        ]
    )
    figures: Figures = {"map": mean_of_valid(table.ravel().tolist())}
    for t, threshold in enumerate(thresholds):
        unit = f"{threshold:g}_m" if detection_set.is_3d else f"{threshold:.2f}"
        figures[f"map_at.{unit}"] = mean_of_valid(table[:, t].tolist())
    for c, name in enumerate(detection_set.classes):
        figures[f"ap.{name}"] = mean_of_valid(table[c].tolist())
    return figures


def _pdq(detection_set: DetectionSet, scores: Sequence[FrameScore], rng: np.random.Generator) -> Figures:
    """Return PDQ of image boxes."""
    counts = [score.pdq for score in scores if score.pdq is not None]
    return {"pdq": pdq(counts)} if counts else {}


def _reliability(
    detection_set: DetectionSet, scores: Sequence[FrameScore], rng: np.random.Generator
) -> Figures:
    """Return the errors of the reliability diagrams."""
    return {
        f"calibration.{name}": diagram.error for name, diagram in _diagrams(detection_set, scores).items()
    }


def _diagrams(detection_set: DetectionSet, scores: Sequence[FrameScore]) -> dict[str, Reliability]:
    """Return diagrams of hits (at 2 m or overlap 0.5) and of existence against associations."""
    score, hit = _joined(scores, "detections", "score"), _joined(scores, "detections", "hit")
    radius = NUSCENES_DISTANCES_M.index(2.0) if detection_set.is_3d else 0
    diagrams = {"d_ece": reliability(score, hit[radius])}
    existence = _joined(scores, "detections", "existence")
    has_object = _joined(scores, "detections", "has_object")
    # Background detections have no association
    bernoulli = ~np.isnan(has_object)
    diagrams["existence"] = reliability(existence[bernoulli], has_object[bernoulli])
    return diagrams


def _calibration(
    detection_set: DetectionSet, scores: Sequence[FrameScore], rng: np.random.Generator
) -> Figures:
    """Return D-ECE by class and range, object-level error, and LaECE (hits at 0.5), LaECE₀ of image boxes."""
    label, score = _joined(scores, "detections", "label"), _joined(scores, "detections", "score")
    hit, overlap = _joined(scores, "detections", "hit"), _joined(scores, "detections", "overlap")
    radius = NUSCENES_DISTANCES_M.index(2.0) if detection_set.is_3d else 0
    of_objects = _joined(scores, "objects", "brier")
    figures: Figures = {
        "brier.hit": float(brier(score, hit[radius]).mean()) if len(score) else None,
        "calibration.object_level": float(of_objects.mean()) if len(of_objects) else None,
    }
    # LaECE: overlap of hits; LaECE₀: any overlap
    outcomes = (
        {} if detection_set.is_3d else {"la_ece": np.where(hit[radius], overlap, 0.0), "la_ece_0": overlap}
    )
    for c, name in enumerate(detection_set.classes):
        figures[f"calibration.d_ece.{name}"] = reliability(score[label == c], hit[radius][label == c]).error
    if any(frame.range_m is not None for frame in detection_set.frames):
        where = np.concatenate([_detection_range_m(frame) for frame in detection_set.frames])
        for low, high in pairwise(RANGES_M):
            inside = (where >= low) & (where < high)
            error = reliability(score[inside], hit[radius][inside]).error
            figures[f"calibration.d_ece.from_{low:g}_m"] = error
    for key, outcome in outcomes.items():
        errors = [
            reliability(score[label == c], outcome[label == c]).error
            for c in range(len(detection_set.classes))
        ]
        figures[f"calibration.{key}"] = mean_of_valid(errors)
    return figures


def _pairs(detection_set: DetectionSet, scores: Sequence[FrameScore], rng: np.random.Generator) -> Figures:
    """Return proper scores, scale of σ and coverage of boxes and objects in the likeliest associations."""
    boxes, objects = [], []
    for frame, score in zip(detection_set.frames, scores, strict=True):
        # Objects whose likeliest association is a detection
        has = np.flatnonzero(score.objects.best >= 0)
        if len(has):
            boxes.append(frame.detected.boxes[score.objects.best[has]])
            objects.append(frame.objects[has])
    if not boxes:
        return {}
    density, truth = _stacked_boxes(boxes), _stacked_objects(objects)
    mean, state = density.mean.numpy(), truth.state.numpy()
    std = density.chol.square().sum(-1).sqrt().numpy()
    crps = crps_gaussian if density.family == "gaussian" else crps_laplace
    axes = ("x_m", "y_m", "z_m") if detection_set.is_3d else ("x1_px", "y1_px", "x2_px", "y2_px")
    figures: Figures = {
        f"crps.{axis}": float(crps(mean[:, d], std[:, d], state[:, d]).mean()) for d, axis in enumerate(axes)
    }
    # At most 2000 boxes, since the energy score draws samples
    some = rng.permutation(len(mean))[:2000]
    figures["energy_score"] = float(energy_score(density[some], truth[some], rng).mean())
    figures["std.best_factor"] = fit_scale(density, truth)
    # Conformal factor from one half of the boxes, its coverage on the other half
    half, rest = np.split(rng.permutation(len(mean)), [len(mean) // 2])
    factor = conformal_factor(density[half], truth[half], COVERAGE)
    figures["conformal.factor_90"] = factor
    figures["conformal.coverage_90"] = float((conformal_scores(density[rest], truth[rest]) <= factor).mean())
    return figures


def _slices(detection_set: DetectionSet, scores: Sequence[FrameScore], rng: np.random.Generator) -> Figures:
    """Return the cost of objects by class, size, range and visibility, nats an object.

    Objects of frames with an infinite likelihood are left out.
    """
    pairs = [
        (frame, score)
        for frame, score in zip(detection_set.frames, scores, strict=True)
        if np.isfinite(score.nll)
    ]
    if not pairs:
        return {}
    # Frames with an infinite likelihood have no costs of single objects
    frames, scores = [frame for frame, _ in pairs], [score for _, score in pairs]
    label = _joined(scores, "objects", "label")
    figures: Figures = _relevance(frames, scores)
    size = np.concatenate([_size(frame.objects, detection_set.is_3d) for frame in frames])
    steps, unit = (LENGTHS_M, "m") if detection_set.is_3d else (SIDES_PX, "px")
    for low, high in pairwise(steps):
        inside = np.flatnonzero((size >= low) & (size < high))
        figures |= _slice(f"by_size.from_{low:g}_{unit}", scores, inside)
    for c, name in enumerate(detection_set.classes):
        figures |= _slice(f"by_class.{name}", scores, np.flatnonzero(label == c))
    if any(frame.range_m is not None for frame in frames):
        range_m = np.concatenate(
            [np.full(len(f.objects.label), np.nan) if f.range_m is None else f.range_m for f in frames]
        )
        for low, high in pairwise(RANGES_M):
            inside = np.flatnonzero((range_m >= low) & (range_m < high))
            figures |= _slice(f"by_range.from_{low:g}_m", scores, inside)
    seen = [frame.visibility for frame in frames if frame.visibility is not None]
    if len(seen) == len(frames) and not np.isnan(np.concatenate(seen)).any():
        visibility = np.concatenate(seen)
        # Thirds of the visibility; equal values give fewer classes
        edges = np.unique(np.quantile(visibility, [0.0, 1 / 3, 2 / 3])) if len(visibility) else visibility
        for low, high in pairwise([*edges.tolist(), np.inf]):
            inside = np.flatnonzero((visibility >= low) & (visibility < high))
            figures |= _slice(f"by_visibility.from_{low:g}", scores, inside)
    return figures


def _relevance(frames: Sequence[DetectionFrame], scores: Sequence[FrameScore]) -> Figures:
    """Return the mean cost of an object, plain and weighted where the truth has weights."""
    cost = sum(_joined(scores, "objects", part) for part in ("localisation", "classification", "missed"))
    if not np.size(cost):
        return {}
    figures: Figures = {"object_cost": float(np.mean(cost))}
    weights = [np.ones(len(f.objects.label)) if f.relevance is None else f.relevance for f in frames]
    if any(frame.relevance is not None for frame in frames):
        weight = np.concatenate(weights)
        weighted = float((weight * cost).sum() / weight.sum()) if weight.any() else None
        figures["object_cost.by_relevance"] = weighted
    return figures


def _detection_range_m(frame: DetectionFrame) -> Float[ndarray, "M"]:
    """Return the distance of each detection over ground. It is NaN if the ego vehicle's place is unknown."""
    if frame.range_m is None:
        return np.full(len(frame.detected.log_existence), np.nan)
    return frame.detected.boxes.mean[:, :2].norm(dim=-1).numpy()


def _size(objects: LabelledBoxes, is_3d: bool) -> Float[ndarray, "N"]:
    """Return lengths in m, or roots of areas in px."""
    state = objects.state.double().numpy()
    if is_3d:
        return np.exp(state[:, 3])
    return np.sqrt((state[:, 2:] - state[:, :2]).prod(-1))


def _slice(name: str, scores: Sequence[FrameScore], which: Int[ndarray, "_"]) -> Figures:
    figures: Figures = {f"{name}.objects": len(which)}
    for part in ("localisation", "classification", "missed", "missed_probability"):
        values: Float[ndarray, _] = _joined(scores, "objects", part)[which]
        figures[f"{name}.{part}"] = float(values.mean()) if len(values) else None
    return figures


def _stacked_boxes(parts: Sequence[BoxDensity]) -> BoxDensity:
    return BoxDensity(
        torch.cat([part.mean for part in parts]),
        torch.cat([part.chol for part in parts]),
        family=parts[0].family,
    )


def _stacked_objects(parts: Sequence[LabelledBoxes]) -> LabelledBoxes:
    return LabelledBoxes(torch.cat([part.label for part in parts]), torch.cat([part.state for part in parts]))


FIGURE_FUNCTIONS: tuple[Callable[[DetectionSet, Sequence[FrameScore], np.random.Generator], Figures], ...] = (
    _counts,
    _likelihood,
    _distances,
    _precision,
    _pdq,
    _reliability,
    _calibration,
    _pairs,
    _slices,
)
"""Functions of all figures, in the order of a summary. They draw from the generator in this order."""
