"""Argoverse 2's measures of forecasts, MFEval's moving vehicles: by hand, and against av2's own figures."""

import dataclasses
import json
import math

import numpy as np
import pytest
from oracles.av2_forecasting import (
    GOLDEN,
    check_forecasting,
    check_single_agents,
    forecasting_scene,
    single_agents,
)
from tasks.motion_scenes import joined, joined_truth, one_agent, perfect, random_predictions, random_truth

from foredrive.scene import Category
from foredrive.tasks.motion.argoverse import (
    NON_LINEAR,
    STATIC,
    forecast_errors,
    forecast_precision,
    kind_of_motion,
)
from foredrive.tasks.motion.moving import is_moving, score_moving


def test_the_best_future_ends_nearest() -> None:
    """The second future is nearer on average, but the first one ends at the truth; p = .4."""
    true = np.zeros((1, 2, 2))
    future = np.array([[[[0.0, 3.0], [0.0, 0.0]], [[0.0, 0.1], [0.0, 0.5]]]])
    errors = forecast_errors(future, np.array([[0.4, 0.6]]), true)
    assert errors.ade_m == pytest.approx([1.5])
    assert errors.fde_m == pytest.approx([0.0])
    assert errors.brier_fde_m == pytest.approx([0.36])
    alone = forecast_errors(future, np.array([[0.4, 0.6]]), true, k=1)
    assert alone.fde_m == pytest.approx([0.5])
    assert alone.brier_fde_m == pytest.approx([0.5 + 0.16])
    far = forecast_errors(future + 2.01, np.array([[2.0, 3.0]]), true)
    assert far.missed.tolist() == [True]


def test_kinds_of_motion_by_hand() -> None:
    """1 m/s for 3 s: static within 1 m + 2.36 m; 4 m/s straight: linear; the same with a stop: neither."""
    steps, threshold = np.array([6]), np.array([1 + 2.36])
    slow, fast = (np.array([[[v * 0.5 * t, 0.0] for t in range(1, 7)]]) for v in (1.0, 4.0))
    here = np.zeros((1, 2))
    assert kind_of_motion(here, slow, steps, threshold) == [STATIC]
    assert kind_of_motion(here, fast, steps, threshold) == [1]
    stops = np.minimum(fast, 4.0)
    assert kind_of_motion(here, stops, steps, threshold) == [NON_LINEAR]


def test_unmatched_detections_are_false_for_their_own_kind_alone() -> None:
    """A standing car is found, and a moving one is made up: the precision of standing cars stays 1.

    Were it standing too, the precision would rise linearly to 1/2 at recall 1: 1/4 on average.
    """
    true = one_agent(speed_mps=0.0)
    made_up = perfect(one_agent(at=(-20.0, 0.0), speed_mps=8.0), score=0.95)
    predicted = dataclasses.replace(joined(perfect(true), made_up), category=np.zeros(2, dtype=np.int64))
    true = dataclasses.replace(true, category=np.zeros(1, dtype=np.int64))
    figures = forecast_precision(predicted, true, ["REGULAR_VEHICLE"])
    assert figures["static.map_f"] == pytest.approx(1.0)
    assert math.isnan(figures["linear.map_f"])
    standing = perfect(one_agent(at=(-20.0, 0.0), speed_mps=0.0), score=0.95)
    figures = forecast_precision(
        dataclasses.replace(joined(perfect(true), standing), category=np.zeros(2, dtype=np.int64)),
        true,
        ["REGULAR_VEHICLE"],
    )
    assert figures["static.map_f"] == pytest.approx(0.25)


def test_parity_with_av2() -> None:
    golden = json.loads(GOLDEN.read_text())
    check_single_agents(*single_agents(), golden["single_agents"])
    check_forecasting(*forecasting_scene(), golden["forecasting"])


def test_moving_vehicles_alone() -> None:
    """A car that drives and one that is parked, both found perfectly: the parked one is no hit, nor false."""
    true = joined_truth(one_agent(), one_agent(at=(20.0, 5.0), speed_mps=0.0))
    assert is_moving(true).tolist() == [True, False]
    scores = score_moving(perfect(true), true)["car"]
    assert (scores.map_f, scores.min_ade_m, scores.miss_rate, scores.agents) == (
        pytest.approx(1.0),
        0.0,
        0.0,
        1,
    )
    clutter = dataclasses.replace(perfect(true[:1]), xy=np.array([[-20.0, 0.0]]))
    with_clutter = score_moving(joined(perfect(true), clutter), true)["car"]
    assert with_clutter.map_f < 1.0


def test_the_best_f1_decides_which_pairs_are_judged() -> None:
    """A poor second detection at a low score is left out of the errors: F1 is best without it."""
    true = joined_truth(one_agent(), one_agent(at=(20.0, 8.0)))
    found = perfect(true)
    future = found.future_xy.copy()
    future[1] += 9.0
    predicted = dataclasses.replace(found, future_xy=future, score=np.array([0.9, 0.2]))
    scores = score_moving(predicted, true)
    assert scores["car"].min_fde_m == 0.0
    assert scores["all"].agents == 2
    assert math.isnan(scores["bus"].min_fde_m)


def test_moving_scores_of_random_scenes_are_sound() -> None:
    rng = np.random.default_rng(2)
    true = random_truth(rng, frames=30)
    predicted = random_predictions(rng, true)
    scores = score_moving(predicted, true)
    agents = (is_moving(true) & np.isin(true.category, (Category.CAR, Category.BUS, Category.TRUCK))).sum()
    assert sum(scores[name].agents for name in ("car", "bus", "truck")) == agents
    assert 0 < scores["all"].map_f < 1
    assert scores["all"].min_ade_m < scores["all"].min_fde_m
