"""Moving vehicles alone, as MFEval judges them.

Source: Xu et al., Towards Motion Forecasting with Real-World Perception Inputs, ICRA 2024; valeoai/MFEval,
eval.py. MFEval takes the moving vehicles from the list of nuScenes' prediction challenge, which other data
lacks: here they are the vehicles with a whole future of 6 s at whose end they are at least 2 m away.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.scene import Category
from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents, displacement_errors
from foredrive.tasks.motion.matching import match_by_distance, match_by_score
from foredrive.tasks.objects.matching import average_precision_nuscenes, precision_recall

STEPS = 12
MATCH_M = 2.0
MISS_M = 4.0
MOVES_M = 2.0
FUTURES = 10
CLASSES = {"car": Category.CAR, "bus": Category.BUS, "truck": Category.TRUCK}
ANY_VEHICLE = (Category.CAR, Category.BUS, Category.TRUCK, Category.CONSTRUCTION_VEHICLE)
"""A prediction on one of these that does not move is left out instead of being false."""


@dataclass(frozen=True)
class MovingScores:
    """Scores of one class, or of all; NaN where there is nothing to count."""

    map_f: float
    """Average precision: a hit is nearer than 2 m now, and one of its futures ends nearer than 4 m."""
    min_ade_m: float
    """Errors of the pairs at the score that is best for F1."""
    min_fde_m: float
    miss_rate: float
    agents: int


def is_moving(true: TrueAgents) -> Bool[ndarray, "N"]:
    """Return which agents have a whole future of 6 s and end at least 2 m from where they are."""
    # Distance at the end of 6 s
    travelled_m = np.linalg.norm(true.future_xy[:, STEPS - 1] - true.xy, axis=1)
    return (true.steps_known(STEPS) == STEPS) & (travelled_m >= MOVES_M)


def score_moving(predicted: PredictedAgents, true: TrueAgents) -> dict[str, MovingScores]:
    """Score forecasts of moving cars, buses and trucks, and of `all` of them together."""
    predicted = predicted[np.isin(predicted.category, list(CLASSES.values()))]
    true = true[np.isin(true.category, ANY_VEHICLE)]
    moving = is_moving(true)
    # Predictions on vehicles that do not move are left out
    true_row = match_by_distance(predicted, true, within_m=MATCH_M)
    predicted = _likeliest(predicted[(true_row < 0) | moving[true_row] if len(moving) else true_row < 0])
    true = true[moving]
    scores, errors = {}, []
    for name, category in CLASSES.items():
        of_class = predicted[predicted.category == category]
        true_of_class = true[true.category == category]
        ap, min_score = _precision(of_class, true_of_class)
        # Errors are those of predictions from the score of the best F1 on
        confident = of_class[of_class.score >= min_score]
        error = _pair_errors(confident, true_of_class)
        errors.append(error)
        scores[name] = _scores(ap, error, len(true_of_class.frame))
    mean_ap = float(np.mean([score.map_f for score in scores.values()]))
    # The mean over classes, and the errors of all pairs together
    scores["all"] = _scores(mean_ap, np.concatenate(errors, axis=1), len(true.frame))
    return scores


def _likeliest(predicted: PredictedAgents) -> PredictedAgents:
    """Keep the ten most probable futures."""
    order = np.argsort(-predicted.probability, axis=1, kind="stable")[:, :FUTURES]
    row = np.arange(len(order))[:, None]
    futures, probability = predicted.future_xy[row, order], predicted.probability[row, order]
    return dataclasses.replace(predicted, future_xy=futures, probability=probability)


def _precision(predicted: PredictedAgents, true: TrueAgents) -> tuple[float, float]:
    """Return the average precision as nuScenes counts it, and the score of the largest F1."""
    objects = len(true.frame)
    if objects == 0 or len(predicted.frame) == 0:
        return 0.0, 0.0
    order, partner = match_by_score(predicted, true, within_m=MATCH_M, end_within_m=MISS_M, horizon=STEPS)
    # F1 at every number of predictions, best scored first
    precision, recall = precision_recall(partner[order] >= 0, objects)
    f1 = 2 * precision * recall / (precision + recall + 1e-5)
    ap = average_precision_nuscenes(predicted.score, partner >= 0, objects)
    return ap, float(predicted.score[order][f1.argmax()])


def _pair_errors(predicted: PredictedAgents, true: TrueAgents) -> Float[ndarray, "2 P"]:
    """Return minADE and minFDE of the pairs."""
    partner = match_by_distance(predicted, true, within_m=MATCH_M)
    pairs = np.flatnonzero(partner >= 0)
    steps: Int[ndarray, P] = np.full(len(pairs), STEPS)
    errors = displacement_errors(predicted.future_xy[pairs], true.future_xy[partner[pairs]], steps)
    return np.stack([errors.mean.min(1), errors.last.min(1)])


def _scores(ap: float, error: Float[ndarray, "2 P"], agents: int) -> MovingScores:
    if not error.shape[1]:
        return MovingScores(ap, float("nan"), float("nan"), float("nan"), agents)
    ade_m, fde_m = error.mean(1)
    return MovingScores(ap, float(ade_m), float(fde_m), float((error[1] > MISS_M).mean()), agents)
