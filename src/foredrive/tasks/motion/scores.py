"""Errors of forecast motion, and end-to-end prediction accuracy (EPA), under a protocol."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.scene import Category
from foredrive.tasks.detection.protocols import error_over_recall
from foredrive.tasks.motion.agents import DisplacementErrors, PredictedAgents, TrueAgents, displacement_errors
from foredrive.tasks.motion.matching import match_by_distance, match_by_score
from foredrive.tasks.motion.protocols import (
    FALSE_POSITIVE_COST,
    MATCH_M,
    MISS_M,
    Disc,
    MotionProtocol,
    Rectangle,
)


@dataclass(frozen=True)
class MotionScores:
    """Scores of one class under a protocol; NaN where there is nothing to count."""

    min_ade_m: float
    min_fde_m: float
    miss_rate: float
    epa: float
    agents: int
    """Annotated agents that EPA divides by."""
    predictions: int
    matched: int
    """Pairs whose errors are counted."""


def score_motion(
    predicted: PredictedAgents, true: TrueAgents, protocol: MotionProtocol
) -> dict[str, MotionScores]:
    """Score forecasts of a whole data set under one protocol, by its classes.

    Raises:
        InputError: the futures are shorter than the protocol's horizon.
    """
    for steps, what in ((predicted.future_xy.shape[2], "predicted"), (true.future_xy.shape[1], "true")):
        if steps < protocol.steps:
            raise InputError(f"{protocol.title} judges {protocol.steps} steps of 0.5 s, {what} are {steps}")
    predicted = predicted[_confident(predicted, protocol)]
    # Boxes that are known to hold no sensor point do not count
    true = true[true.seen]
    score = _score_by_confidence if protocol.matching == "score" else _score_nearest
    return score(predicted, true, protocol)


def _confident(predicted: PredictedAgents, protocol: MotionProtocol) -> Bool[ndarray, "M"]:
    if protocol.min_score_kept:
        return predicted.score >= protocol.min_score
    return predicted.score > protocol.min_score


def _is_any(category: Int[ndarray, "n"], wanted: frozenset[Category]) -> Bool[ndarray, "n"]:
    return np.isin(category, sorted(wanted))


def _score_by_confidence(
    predicted: PredictedAgents, true: TrueAgents, protocol: MotionProtocol
) -> dict[str, MotionScores]:
    """Score each class by itself, the best scored prediction first."""
    scores = {}
    # Detections and agents of the class, within its region
    for name, categories in protocol.classes.items():
        scores[name] = _score_class(
            predicted[_is_any(predicted.category, categories) & _within(predicted, protocol.region, name)],
            true[_is_any(true.category, categories) & _within(true, protocol.region, name)],
            protocol,
        )
    return scores


def _score_class(predicted: PredictedAgents, true: TrueAgents, protocol: MotionProtocol) -> MotionScores:
    objects, predictions = len(true.frame), len(predicted.frame)
    if objects == 0:
        nan = float("nan")
        return MotionScores(nan, nan, nan, nan, 0, predictions, 0)
    order, partner = match_by_score(predicted, true, within_m=MATCH_M)
    # EPA matches again: a hit must also end near the agent
    _, hit_again = match_by_score(
        predicted, true, within_m=MATCH_M, end_within_m=MISS_M, horizon=protocol.steps
    )
    # Pairs in order of the score, as the errors are averaged over recall
    pairs = order[partner[order] >= 0]
    errors = _pair_errors(predicted, true, pairs, partner[pairs], protocol.steps)
    score, hit = predicted.score[order], partner[order] >= 0
    min_ade_m, min_fde_m, miss_rate = (
        error_over_recall(score, hit, objects, values)
        for values in (errors.mean.min(1), errors.last.min(1), 1.0 * _missed(errors, protocol))
    )
    false_positives = predictions - len(pairs)
    # EPA: hits less half of the false positives, per agent
    epa = ((hit_again >= 0).sum() - FALSE_POSITIVE_COST * false_positives) / objects
    return MotionScores(min_ade_m, min_fde_m, miss_rate, float(epa), objects, predictions, len(pairs))


def _score_nearest(
    predicted: PredictedAgents, true: TrueAgents, protocol: MotionProtocol
) -> dict[str, MotionScores]:
    """Match across classes by distance; an error is of the agent's class, a false positive of its own."""
    # Ignored categories take part in the matching and have no figures of their own
    in_play = frozenset[Category]().union(protocol.ignored, *protocol.classes.values())
    predicted = predicted[_is_any(predicted.category, in_play) & _within(predicted, protocol.region)]
    true = true[_is_any(true.category, in_play) & _within(true, protocol.region)]
    partner = match_by_distance(predicted, true, within_m=MATCH_M)
    steps = true.steps_known(protocol.steps)
    pairs = np.flatnonzero(partner >= 0)
    # Pairs without a known step are skipped
    pairs = pairs[steps[partner[pairs]] > 0]
    errors = _pair_errors(predicted, true, pairs, partner[pairs], protocol.steps)
    # FDE and misses need the whole future
    whole = steps[partner[pairs]] == protocol.steps
    missed = _missed(errors, protocol)
    scores = {}
    for name, categories in protocol.classes.items():
        of_class = _is_any(true.category[partner[pairs]], categories)
        judged = of_class & whole
        predictions = _is_any(predicted.category, categories)
        objects = int((_is_any(true.category, categories) & (steps == protocol.steps)).sum())
        # Of VAD's EPA: hits of the agent's class, false positives of the prediction's class
        hits = (judged & ~missed).sum() - FALSE_POSITIVE_COST * (predictions & (partner < 0)).sum()
        scores[name] = MotionScores(
            _mean(errors.mean.min(1)[of_class]),
            _mean(errors.last.min(1)[judged]),
            _mean(missed[judged].astype(np.float64)),
            float(hits / objects) if objects else float("nan"),
            objects,
            int(predictions.sum()),
            int(of_class.sum()),
        )
    return scores


def _pair_errors(
    predicted: PredictedAgents,
    true: TrueAgents,
    pairs: Int[ndarray, "P"],
    agent: Int[ndarray, "P"],
    horizon: int,
) -> DisplacementErrors:
    steps = true.steps_known(horizon)[agent]
    return displacement_errors(predicted.future_xy[pairs], true.future_xy[agent], steps)


def _missed(errors: DisplacementErrors, protocol: MotionProtocol) -> Bool[ndarray, "P"]:
    off_m = errors.worst if protocol.miss == "any_step" else errors.last
    # The best of the futures decides
    return np.asarray(off_m.min(1) > MISS_M)


def _within(
    agents: PredictedAgents | TrueAgents, region: Disc | Rectangle, name: str = ""
) -> Bool[ndarray, "n"]:
    """Return which agents a protocol's region holds; `name` is the class, which matters for a disc."""
    if isinstance(region, Disc):
        return np.asarray(np.linalg.norm(agents.xy, axis=1) < region.range_m[name])
    # The rectangle is larger for predictions, as VAD keeps them in a larger range
    half_m = region.true_half_xy_m if isinstance(agents, TrueAgents) else region.predicted_half_xy_m
    return np.asarray((np.abs(agents.xy - (region.forward_m, 0.0)) < half_m).all(1))


def _mean(values: Float[ndarray, "n"]) -> float:
    return float(values.mean()) if len(values) else float("nan")


def motion_figures(scores: Mapping[str, MotionScores]) -> dict[str, float]:
    """Return scores under flat keys: `car.min_ade_m`, `car.epa`, …"""
    return {
        f"{name}.{key}": value
        for name, class_scores in scores.items()
        for key, value in vars(class_scores).items()
    }
