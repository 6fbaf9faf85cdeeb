"""Motion protocols: cases by hand wherever two differ, invariants, and parity with a literal derivation."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tasks.motion_by_hand import uniad, vad
from tasks.motion_scenes import (
    joined,
    joined_truth,
    one_agent,
    perfect,
    random_predictions,
    random_truth,
)

from foredrive.errors import InputError
from foredrive.scene import Category
from foredrive.tasks.detection.protocols import error_over_recall
from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents, displacement_errors
from foredrive.tasks.motion.matching import match_by_distance, match_by_score
from foredrive.tasks.motion.protocols import PROTOCOLS
from foredrive.tasks.motion.scores import MotionScores, motion_figures, score_motion

KEYS = ("min_ade_m", "min_fde_m", "miss_rate", "epa")


def car(predicted: PredictedAgents, true: TrueAgents, name: str) -> MotionScores:
    return score_motion(predicted, true, PROTOCOLS[name])["car"]


def off_by(true: TrueAgents, metres: list[float], score: float = 0.9) -> PredictedAgents:
    """Detected where it is; all futures are off sideways by so much at each step."""
    found = perfect(true, score)
    future = found.future_xy.copy()
    future[..., 1] += metres
    return dataclasses.replace(found, future_xy=future)


def test_errors_by_hand() -> None:
    """Two futures: 1 and 3 m off, or 2.5 and 0 m off; and no known step."""
    future = np.array([[[[0.0, 1.0], [0.0, 3.0]], [[2.5, 0.0], [0.0, 0.0]]]])
    errors = displacement_errors(future, np.zeros((1, 2, 2)), np.array([2]))
    np.testing.assert_allclose(errors.mean, [[2.0, 1.25]])
    np.testing.assert_allclose(errors.last, [[3.0, 0.0]])
    np.testing.assert_allclose(errors.worst, [[3.0, 2.5]])
    nothing = displacement_errors(future, np.zeros((1, 2, 2)), np.array([0]))
    assert not nothing.mean.any()
    assert not nothing.last.any()


def test_a_swerve_is_a_miss_where_any_step_counts() -> None:
    """3 m off at step 3 alone: VAD looks at the last step."""
    true = one_agent()
    predicted = off_by(true, [0, 0, 3.0, *[0] * 9])
    assert car(predicted, true, "uniad").miss_rate == 1.0
    assert car(predicted, true, "vad").miss_rate == 0.0
    assert car(predicted, true, "uniad").min_ade_m == pytest.approx(3 / 12)
    assert car(predicted, true, "vad").min_ade_m == pytest.approx(3 / 6)


def test_horizons_differ() -> None:
    """Right for 3 s, then 4 m off."""
    true = one_agent()
    predicted = off_by(true, [*[0] * 6, *[4.0] * 6])
    assert car(predicted, true, "sparsedrive").min_fde_m == pytest.approx(4.0)
    assert car(predicted, true, "vad").min_fde_m == 0.0
    assert car(predicted, true, "sparsedrive").epa == -0.0
    assert car(predicted, true, "vad").epa == 1.0


def test_an_agent_without_future_counts_as_no_error_or_not_at_all() -> None:
    """Errors of 1 m at score 0.9, and no future at 0.8.

    UniAD: up to recall .5 the running mean is 1, then it falls with the score to .5, so at recall r it is
    1.5 - r: over recall .11 … 1 that is (40 · 1 + Σ (1.5 - r)) / 90 = (40 + 37.25) / 90.
    """
    true = joined_truth(one_agent(), one_agent(at=(20.0, 5.0), known=0))
    predicted = off_by(true, [1.0] * 12)
    predicted = dataclasses.replace(predicted, score=np.array([0.9, 0.8]))
    assert car(predicted, true, "uniad").min_ade_m == pytest.approx(77.25 / 90)
    assert car(predicted, true, "uniad").epa == pytest.approx(1 / 2)  # no future, no hit, but an agent
    assert car(predicted, true, "vad").min_ade_m == pytest.approx(1.0)
    assert car(predicted, true, "vad").epa == pytest.approx(1.0)
    assert car(predicted, true, "vad").matched == 1


def test_a_future_cut_short() -> None:
    """Four steps known, 1 m off: VAD counts the mean error, but neither FDE nor miss nor EPA."""
    true = one_agent(known=4)
    scores = car(off_by(true, [1.0] * 12), true, "vad")
    assert scores.min_ade_m == pytest.approx(1.0)
    assert math.isnan(scores.min_fde_m)
    assert math.isnan(scores.epa)
    scores = car(off_by(true, [1.0] * 12), true, "uniad")
    assert (scores.min_fde_m, scores.epa) == (pytest.approx(1.0), pytest.approx(1.0))


def test_epa_matches_again_in_uniad_alone() -> None:
    """The nearer and better scored detection has a wrong future; the other, 1 m away, a right one.

    UniAD's second matching gives the agent to the other: 1 hit - 0.5 for one detection without an agent.
    VAD keeps the nearer: no hit, and the other is false.
    """
    true = one_agent()
    wrong = off_by(true, [9.0] * 12)
    right = perfect(true, score=0.7)
    right = dataclasses.replace(right, xy=right.xy + np.array([0.0, 1.0]))
    predicted = joined(wrong, right)
    assert car(predicted, true, "uniad").epa == pytest.approx(0.5)
    assert car(predicted, true, "uniad").min_fde_m == pytest.approx(9.0)
    assert car(predicted, true, "vad").epa == pytest.approx(-0.5)


def test_pairs_by_score_or_by_distance() -> None:
    """The better scored detection takes the agent between; by distance two pairs are found."""
    true = joined_truth(one_agent(at=(10.0, 0.0)), one_agent(at=(11.5, 0.0)))
    found = perfect(true)
    # at 11 m the nearest is 11.5; the other detection, at 12 m, then has 10 left: exactly 2 m
    predicted = dataclasses.replace(
        found, xy=np.array([[11.0, 0.0], [12.0, 0.0]]), score=np.array([0.9, 0.8])
    )
    order, by_score = match_by_score(predicted, true, within_m=2.0)
    assert order.tolist() == [0, 1]
    assert by_score.tolist() == [1, -1]  # 2 m is not below 2 m
    assert match_by_distance(predicted, true, within_m=2.0).tolist() == [0, 1]
    assert car(predicted, true, "uniad").matched == 1
    assert car(predicted, true, "vad").matched == 2


def test_classes_differ() -> None:
    """A construction vehicle and a cyclist are UniAD's cars; VAD ignores both."""
    true = joined_truth(
        one_agent(Category.CONSTRUCTION_VEHICLE), one_agent(Category.BICYCLE, at=(20.0, 3.0)), one_agent()
    )
    true = dataclasses.replace(true, frame=np.array([0, 1, 2]))
    assert car(perfect(true), true, "uniad").agents == 3
    assert car(perfect(true), true, "vad").agents == 1
    assert car(perfect(true), true, "vad").epa == 1.0  # the cyclist's detection is not false


def test_vad_matches_across_classes() -> None:
    """A pedestrian's detection on a car is right about the car in VAD, and false in UniAD."""
    true = joined_truth(one_agent(), one_agent(Category.PEDESTRIAN, at=(-9.0, 5.0)))
    predicted = dataclasses.replace(
        perfect(true), category=np.array([int(Category.PEDESTRIAN), int(Category.PEDESTRIAN)])
    )
    scores = score_motion(predicted, true, PROTOCOLS["vad"])
    assert (scores["car"].epa, scores["pedestrian"].epa) == (1.0, 1.0)
    scores = score_motion(predicted, true, PROTOCOLS["uniad"])
    assert scores["car"].epa == 0.0
    assert scores["pedestrian"].epa == pytest.approx(0.5)
    assert scores["car"].min_ade_m == 1.0  # the devkit's error of a class without a hit


@pytest.mark.parametrize(
    ("score", "counted"),
    [
        (0.19, ()),
        (0.2, ("sparsedrive",)),
        (0.35, ("sparsedrive", "uniad")),
        (0.6, ("sparsedrive", "uniad")),
        (0.61, ("sparsedrive", "uniad", "vad")),
    ],
)
def test_score_floors(score: float, counted: tuple[str, ...]) -> None:
    true = one_agent()
    found = {name for name in PROTOCOLS if car(perfect(true, score), true, name).predictions}
    assert found == set(counted)


def test_regions() -> None:
    """A cyclist 45 m ahead counts as a car of UniAD; VAD's area ends 30 m ahead of the lidar, 15 m aside."""
    for at, uniads, vads in (
        ((45.0, 0.0), 1, 0),
        ((51.0, 0.0), 0, 0),
        ((30.9, 14.9), 1, 1),
        ((0, 15.1), 1, 0),
    ):
        true = one_agent(Category.CAR, at=at)
        assert car(perfect(true), true, "uniad").agents == uniads
        assert car(perfect(true), true, "vad").agents == vads
    true = one_agent(Category.PEDESTRIAN, at=(41.0, 0.0))
    assert score_motion(perfect(true), true, PROTOCOLS["uniad"])["pedestrian"].agents == 0


def test_vad_counts_detections_beside_its_area_as_false() -> None:
    """Its detections reach 35 m ahead and 20 m aside, its annotations 30 m and 15 m."""
    true = joined_truth(one_agent(), one_agent(at=(10.0, 17.0)))
    assert car(perfect(true), true, "vad").epa == pytest.approx(0.5)


def test_boxes_without_points_are_no_agents() -> None:
    true = dataclasses.replace(one_agent(), seen=np.array([False]))
    for name in PROTOCOLS:
        assert car(perfect(true), true, name).agents == 0


def test_false_positives_alone() -> None:
    """No hit: what EPA's formula says, and the devkit's errors of 1."""
    true = one_agent()
    predicted = dataclasses.replace(perfect(true), xy=np.array([[0.0, 14.0]]))
    scores = car(predicted, true, "uniad")
    assert (scores.min_ade_m, scores.miss_rate, scores.epa) == (1.0, 1.0, -0.5)
    scores = car(predicted, true, "vad")
    assert math.isnan(scores.min_ade_m)
    assert scores.epa == -0.5


def test_recall_below_the_first_step_is_an_error_of_one() -> None:
    """One hit of ten objects: recall .1."""
    assert error_over_recall(np.array([0.9]), np.array([True]), 10, np.array([0.0])) == 1.0
    assert error_over_recall(np.array([0.9]), np.array([True]), 9, np.array([0.3])) == pytest.approx(0.3)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("name", "floor"), [("uniad", 0.35), ("sparsedrive", 0.2)])
def test_parity_with_a_literal_derivation(seed: int, name: str, floor: float) -> None:
    rng = np.random.default_rng(seed)
    true = random_truth(rng)
    predicted = random_predictions(rng, true)
    scores = score_motion(predicted, true, PROTOCOLS[name])
    for kind in ("car", "pedestrian"):
        expected = uniad(predicted, true, kind, floor)
        assert {key: getattr(scores[kind], key) for key in KEYS} == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_parity_of_vad_with_a_literal_derivation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = random_truth(rng, frames=60)
    predicted = random_predictions(rng, true)
    expected = vad(predicted, true)
    for kind, scores in score_motion(predicted, true, PROTOCOLS["vad"]).items():
        assert scores.matched > 5
        assert {key: getattr(scores, key) for key in KEYS} == pytest.approx(expected[kind], abs=1e-9)


@pytest.mark.parametrize("name", list(PROTOCOLS))
def test_perfect_forecasts(name: str) -> None:
    true = random_truth(np.random.default_rng(7))
    everything = np.ones_like(true.future_valid)
    true = dataclasses.replace(true, future_valid=everything, seen=everything[:, 0])
    true = true[(np.abs(true.xy) < (29.0, 14.0)).all(1)]
    for scores in score_motion(perfect(true), true, PROTOCOLS[name]).values():
        assert (scores.min_ade_m, scores.min_fde_m, scores.miss_rate) == (0.0, 0.0, 0.0)
        assert scores.epa == pytest.approx(1.0)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000), angle=st.floats(-3, 3), name=st.sampled_from(["uniad", "sparsedrive"]))
def test_turning_everything_changes_nothing(seed: int, angle: float, name: str) -> None:
    rng = np.random.default_rng(seed)
    true = random_truth(rng, frames=3)
    predicted = random_predictions(rng, true)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    turned, truth = (
        dataclasses.replace(agents, xy=agents.xy @ turn, future_xy=agents.future_xy @ turn)
        for agents in (predicted, true)
    )
    before, after = (
        motion_figures(score_motion(p, t, PROTOCOLS[name])) for p, t in ((predicted, true), (turned, truth))
    )
    assert after == pytest.approx(before, abs=1e-6, nan_ok=True)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000), name=st.sampled_from(list(PROTOCOLS)))
def test_the_order_of_agents_does_not_matter(seed: int, name: str) -> None:
    rng = np.random.default_rng(seed)
    true = random_truth(rng, frames=3)
    predicted = random_predictions(rng, true)
    predicted = dataclasses.replace(predicted, score=rng.permutation(len(predicted.score)) / 100 % 1)
    distinct = np.unique(predicted.score, return_index=True)[1]
    predicted = predicted[distinct]
    shuffled = predicted[rng.permutation(len(distinct))], true[rng.permutation(len(true.frame))]
    before, after = (
        motion_figures(score_motion(p, t, PROTOCOLS[name])) for p, t in ((predicted, true), shuffled)
    )
    assert after == pytest.approx(before, abs=1e-9, nan_ok=True)


def test_more_futures_are_never_worse() -> None:
    true = random_truth(np.random.default_rng(3))
    predicted = random_predictions(np.random.default_rng(3), true)
    two, probability = predicted.future_xy[:, :2], predicted.probability[:, :2]
    fewer = dataclasses.replace(predicted, future_xy=two, probability=probability)
    for name in PROTOCOLS:
        assert car(predicted, true, name).min_ade_m <= car(fewer, true, name).min_ade_m


def test_short_futures_are_refused() -> None:
    true = one_agent()
    short = dataclasses.replace(perfect(true), future_xy=perfect(true).future_xy[:, :, :6])
    with pytest.raises(InputError, match=r"^UniAD judges 12 steps of 0\.5 s, predicted are 6$"):
        score_motion(short, true, PROTOCOLS["uniad"])
    assert car(short, true, "vad").epa == 1.0


def test_nothing_at_all() -> None:
    true = random_truth(np.random.default_rng(0))
    predicted = random_predictions(np.random.default_rng(0), true)
    for name in PROTOCOLS:
        nobody = car(predicted, true[:0], name)
        assert math.isnan(nobody.epa)
        nothing = car(predicted[:0], true, name)
        assert nothing.epa == 0.0
