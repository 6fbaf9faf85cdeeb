"""Argoverse 2's measures of motion forecasting: of single agents, and end to end (mAP_F).

Sources: av2-api 0.3.6, datasets/motion_forecasting/eval/metrics.py and evaluation/forecasting/{eval,utils,
constants}.py; the best of K futures is, as in Argoverse's challenges, the one that ends nearest. mAP_F is of
Peri et al., Forecasting from LiDAR via Future Object Detection, CVPR 2022.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents, displacement_errors
from foredrive.tasks.motion.matching import match_by_score
from foredrive.tasks.motion.protocols import MISS_M, STEP_S
from foredrive.tasks.objects.matching import mean_of_valid

STEPS = 6
"""Steps of 0.5 s that mAP_F judges."""
FUTURES = 5
"""Futures of an agent that mAP_F reads, in the order in which they are given."""
RANGE_M = 50.0
DISTANCES_M = (0.5, 1.0, 2.0, 4.0)
ERROR_DISTANCE_M = 2.0
"""Distance of the matches whose ADE and FDE are reported."""
MAX_ERROR_M = 50.0
"""Errors of a class of which no forecast is right, and the largest that are reported."""
STATIC, LINEAR, NON_LINEAR = range(3)
MOTION_NAMES = ("static", "linear", "non_linear")
MEAN_SPEED_MPS = {
    "ARTICULATED_BUS": 4.58,
    "BICYCLE": 0.97,
    "BICYCLIST": 3.61,
    "BOLLARD": 0.02,
    "BOX_TRUCK": 2.59,
    "BUS": 3.10,
    "CONSTRUCTION_BARREL": 0.03,
    "CONSTRUCTION_CONE": 0.02,
    "DOG": 0.72,
    "LARGE_VEHICLE": 1.56,
    "MESSAGE_BOARD_TRAILER": 0.41,
    "MOBILE_PEDESTRIAN_CROSSING_SIGN": 0.03,
    "MOTORCYCLE": 1.58,
    "MOTORCYCLIST": 4.08,
    "PEDESTRIAN": 0.80,
    "REGULAR_VEHICLE": 2.36,
    "SCHOOL_BUS": 4.44,
    "SIGN": 0.05,
    "STOP_SIGN": 0.09,
    "STROLLER": 0.91,
    "TRUCK": 2.76,
    "TRUCK_CAB": 2.36,
    "VEHICULAR_TRAILER": 1.72,
    "WHEELCHAIR": 1.50,
    "WHEELED_DEVICE": 0.37,
    "WHEELED_RIDER": 2.03,
}
"""Mean speed of Argoverse 2's classes, m/s, as its evaluation states them: it widens thresholds with time."""


@dataclass(frozen=True)
class ForecastErrors:
    """Errors of N agents' best futures: those that end nearest to the truth."""

    ade_m: Float[ndarray, "N"]
    fde_m: Float[ndarray, "N"]
    missed: Bool[ndarray, "N"]
    """True if the end is more than 2 m off."""
    brier_fde_m: Float[ndarray, "N"]
    """FDE + (1 - p)², with p the probability of that future."""


def forecast_errors(
    future_xy: Float[ndarray, "N K T 2"],
    probability: Float[ndarray, "N K"],
    true_xy: Float[ndarray, "N T 2"],
    *,
    k: int = 6,
) -> ForecastErrors:
    """Return the errors of the `k` most probable futures of agents that are given, with known futures.

    Probabilities of all K futures are divided by their sum.
    """
    # Probabilities are normalised before the best k are chosen
    share = probability / probability.sum(1, keepdims=True)
    likely = np.argsort(-share, axis=1, kind="stable")[:, :k]
    row = np.arange(len(future_xy))
    steps = np.full(len(future_xy), true_xy.shape[1])
    errors = displacement_errors(future_xy[row[:, None], likely], true_xy, steps)
    # The best future is the one that ends nearest
    best = errors.last.argmin(1)
    fde_m = errors.last[row, best]
    return ForecastErrors(
        errors.mean[row, best],
        fde_m,
        fde_m > MISS_M,
        fde_m + (1.0 - share[row, likely[row, best]]) ** 2,
    )


@dataclass(frozen=True)
class ForecastPrecision:
    """Forecasting AP at one distance, ADE and FDE of one class of agents of one kind of motion."""

    ap: float
    ade_m: float
    fde_m: float


def forecast_precision(
    predicted: PredictedAgents, true: TrueAgents, classes: Sequence[str]
) -> dict[str, float]:
    """Return mAP_F, ADE and FDE: over all classes, by kind of motion and by class; NaN without agents.

    Args:
        predicted: five futures each, of which the first six steps are read.
        true: agents with at least one known step count.
        classes: names of the categories, keys of `MEAN_SPEED_MPS`.
    """
    # Agents in range with at least one known step
    true = true[(true.steps_known(STEPS) > 0) & (np.linalg.norm(true.xy, axis=1) < RANGE_M)]
    predicted = predicted[np.linalg.norm(predicted.xy, axis=1) < RANGE_M]
    speed_mps = np.array([MEAN_SPEED_MPS[name] for name in classes])
    steps = true.steps_known(STEPS)
    # The threshold grows with the class's mean speed and the length of the known future
    threshold_m = 1.0 + steps / STEPS * speed_mps[true.category]
    # Agents by the simplest motion that explains their future
    kind = kind_of_motion(true.xy, true.future_xy, steps, threshold_m)
    likely = predicted.probability.argmax(1)
    # The released code takes the number of futures here, not that of their steps.
    share = min(predicted.future_xy.shape[1], STEPS) / STEPS
    guess = kind_of_motion(
        predicted.xy,
        predicted.future_xy[np.arange(len(likely)), likely],
        np.full(len(likely), STEPS),
        1.0 + share * speed_mps[predicted.category],
    )
    table: dict[tuple[str, str], ForecastPrecision] = {}
    for label, name in enumerate(classes):
        of_class, true_of_class = predicted.category == label, true.category == label
        for motion, motion_name in enumerate(MOTION_NAMES):
            # A class is judged for each kind of motion on its own
            table[name, motion_name] = _precision_of_motion(
                predicted[of_class],
                guess[of_class] == motion,
                true[true_of_class & (kind == motion)],
                float(speed_mps[label]),
            )
    return _averaged(table, classes)


def kind_of_motion(
    xy: Float[ndarray, "n 2"],
    future_xy: Float[ndarray, "n T 2"],
    steps: Int[ndarray, "n"],
    threshold_m: Float[ndarray, "n"],
) -> Int[ndarray, "n"]:
    """Return STATIC, LINEAR or NON_LINEAR: the simplest extrapolation that is right at the last step.

    Right is nearer than `threshold_m`. The velocity is that of the first step.
    """
    # Position at the last known step, and the one that constant velocity leads to
    last = future_xy[np.arange(len(xy)), steps - 1]
    velocity_mps = (future_xy[:, 0] - xy) / STEP_S
    linear = xy + velocity_mps * (steps * STEP_S)[:, None]
    stays = np.linalg.norm(last - xy, axis=1) < threshold_m
    goes_on = np.linalg.norm(last - linear, axis=1) < threshold_m
    return np.where(stays, STATIC, np.where(goes_on, LINEAR, NON_LINEAR))


def _precision_of_motion(
    predicted: PredictedAgents, guessed: Bool[ndarray, "M"], true: TrueAgents, speed_mps: float
) -> ForecastPrecision:
    """Return the mean AP over the distances, and the errors at 2 m."""
    precisions = [precision_at(predicted, guessed, true, speed_mps, distance_m) for distance_m in DISTANCES_M]
    at_distance = precisions[DISTANCES_M.index(ERROR_DISTANCE_M)]
    return ForecastPrecision(
        float(np.mean([score.ap for score in precisions])), at_distance.ade_m, at_distance.fde_m
    )


def precision_at(
    predicted: PredictedAgents,
    guessed: Bool[ndarray, "M"],
    true: TrueAgents,
    speed_mps: float,
    distance_m: float,
) -> ForecastPrecision:
    """Return the forecasting AP of agents of one class and one kind of motion.

    A detection nearer than `distance_m` to an agent is right if its future with the least ADE ends nearer
    than `distance_m` + `speed_mps` · share of the horizon. Detections without an agent are false only where
    `guessed` is True: the motion of their likeliest future is of this kind.
    """
    if len(true.frame) == 0:
        return ForecastPrecision(float("nan"), float("nan"), float("nan"))
    # Detections take the nearest agent in order of their scores
    order, partner = match_by_score(predicted, true, within_m=distance_m)
    pairs = order[partner[order] >= 0]
    agent = partner[pairs]
    steps = true.steps_known(STEPS)[agent]
    errors = displacement_errors(predicted.future_xy[pairs, :FUTURES], true.future_xy[agent], steps)
    # The best future by ADE decides, also about FDE
    best = errors.mean.argmin(1)
    row = np.arange(len(pairs))
    ade_m, fde_m = errors.mean[row, best], errors.last[row, best]
    right = np.zeros(len(order), dtype=bool)
    # A forecast is right if it ends within a distance that grows with the horizon
    right[pairs] = fde_m < distance_m + steps / STEPS * speed_mps
    if not right.any():
        return ForecastPrecision(0.0, MAX_ERROR_M, MAX_ERROR_M)
    # Detections without an agent are false only if they are predicted to move in this way
    hit = right[order][(partner[order] >= 0) | guessed[order]]
    hits = np.cumsum(hit)
    precision, recall = hits / np.arange(1, len(hit) + 1), hits / len(true.frame)
    # Precision at 101 recalls, 0 beyond the largest one
    ap = np.interp(np.linspace(0, 1, 101), recall, precision, right=0.0).mean()
    return ForecastPrecision(
        float(ap), min(float(ade_m.mean()), MAX_ERROR_M), min(float(fde_m.mean()), MAX_ERROR_M)
    )


def _averaged(table: dict[tuple[str, str], ForecastPrecision], classes: Sequence[str]) -> dict[str, float]:
    """Return means over the entries that have agents, under flat keys."""
    # Means over everything, by kind of motion, by class, and single entries
    groups = {"": list(table.values())}
    groups |= {f"{m}.": [table[name, m] for name in classes] for m in MOTION_NAMES}
    groups |= {f"{name}.": [table[name, m] for m in MOTION_NAMES] for name in classes}
    groups |= {f"{name}.{m}.": [score] for (name, m), score in table.items()}
    return {
        f"{group}{key}": mean_of_valid([getattr(score, name) for score in scores])
        for group, scores in groups.items()
        for key, name in (("map_f", "ap"), ("ade_m", "ade_m"), ("fde_m", "fde_m"))
    }
