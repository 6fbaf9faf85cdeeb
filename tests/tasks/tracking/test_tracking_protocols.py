"""Cases in which tracking protocols differ, or in which nuScenes' rules surprise, worked out by hand."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foredrive.tasks.objects.object_rows import Frames, ObjectRows, make_rows
from foredrive.tasks.tracking.protocols import (
    TRACKING_PROTOCOLS,
    TrackingFigures,
    evaluate_tracking,
    mean_scores,
    recall_thresholds,
    whole_tracks,
)

NUSCENES = TRACKING_PROTOCOLS["nuscenes"]
CAR = NUSCENES.classes.index("car")
Seen = tuple[int, float, str, float]
"""Frame, place ahead of the ego vehicle (m), identity, score."""


def rows(seen: list[Seen]) -> ObjectRows:
    names = sorted({each[2] for each in seen})
    n, x = len(seen), np.array([each[1] for each in seen])
    return make_rows(
        np.array([each[0] for each in seen], dtype=np.int64),
        np.full(n, CAR),
        np.c_[x, np.zeros((n, 2))],
        np.full((n, 3), 2.0),
        np.zeros(n),
        score=np.array([each[3] for each in seen], dtype=np.float64),
        from_ego=np.c_[x, np.zeros(n)],
        track=np.array([names.index(each[2]) for each in seen], dtype=np.int64),
    )


def frames(count: int) -> Frames:
    return Frames(np.zeros(count, np.int64), 500_000 * np.arange(count))


def evaluate(
    true: list[Seen], found: list[Seen], protocol: str = "nuscenes", count: int = 4
) -> TrackingFigures:
    truth, none = rows(true), rows(true)[np.zeros(0, np.int64)]
    return evaluate_tracking(rows(found), truth, none, frames(count), TRACKING_PROTOCOLS[protocol])


def track(name: str, score: float, *at: int, x: float = 5.0) -> list[Seen]:
    return [(f, x, name, score) for f in at]


TRUE = track("t", math.nan, 0, 1, 2, 3)


def test_recall_counts_a_switch_and_motar_does_not() -> None:
    """Two matches, a switch and a match; one false box in each of two frames.

    Recall 4/4. MOTAR is 1 - 2/3, as if three boxes were found. MOTA is 1 - (1 + 2) / 4.
    """
    found = track("a", 0.9, 0, 1) + track("b", 0.9, 2, 3) + track("far", 0.9, 1, 2, x=30.0)
    car = evaluate(TRUE, found).by_class["car"]
    assert car["recall"] == 1.0
    assert car["motar"] == pytest.approx(1 - 2 / 3)
    assert car["mota"] == pytest.approx(1 - 3 / 4)
    assert (car["tp"], car["ids"], car["fp"], car["fn"]) == (3, 1, 2, 0)


def test_floors_of_the_score() -> None:
    """A track of mean score .3: nuScenes and SparseDrive have it, UniAD has nothing."""
    found = track("a", 0.3, 0, 1, 2, 3)
    amota = {name: evaluate(TRUE, found, name).all_classes["amota"] for name in TRACKING_PROTOCOLS}
    assert amota == {"nuscenes": 1.0, "sparsedrive": 1.0, "uniad": 0.0}


def test_a_floor_comes_before_the_mean_score_and_leaves_a_gap_to_fill() -> None:
    """The second of three boxes has score .3 and is 1.5 m off; a false track of score .75 lies elsewhere.

    For nuScenes the track has the mean score .7, below the false one: MOTAR is 1 - 3/3 at best. UniAD drops
    the weak box. The others have .9, and the gap is filled where they are: nothing is false above .75.
    """
    true, false = track("t", math.nan, 0, 1, 2), track("far", 0.75, 0, 1, 2, x=30.0)
    found = [*track("a", 0.9, 0, 2), (1, 6.5, "a", 0.3), *false]
    figures = {name: evaluate(true, found, name, 3).by_class["car"] for name in ("nuscenes", "uniad")}
    assert (figures["nuscenes"]["amota"], figures["uniad"]["amota"]) == (0.0, pytest.approx(1.0))
    assert (figures["nuscenes"]["motp"], figures["uniad"]["motp"]) == (pytest.approx(0.5), pytest.approx(0.0))


def test_gaps_run_backwards_as_in_the_devkit() -> None:
    """From 0 m to 3 m with two boxes missing: they are put at 2 m and 1 m, not at 1 m and 2 m."""
    whole = whole_tracks(rows([(0, 0.0, "a", 0.5), (3, 3.0, "a", 0.7)]), frames(4))
    assert whole.frame.tolist() == [0, 1, 2, 3]
    assert whole.centre[:, 0] == pytest.approx([0.0, 2.0, 1.0, 3.0])
    assert whole.score == pytest.approx([0.6] * 4)  # the mean, for every box


def test_tracks_of_two_scenes_are_not_joined() -> None:
    two = Frames(np.array([0, 0, 1, 1]), np.array([0, 500_000, 0, 500_000]))
    whole = whole_tracks(rows([(0, 0.0, "a", 0.4), (3, 3.0, "a", 0.8)]), two)
    assert whole.frame.tolist() == [0, 3]
    assert whole.score.tolist() == [0.4, 0.8]


def test_truth_without_points_is_filled_again() -> None:
    """The middle box has no points and is dropped, but its track has a box before and after."""
    true = rows(TRUE[:3])
    true = dataclasses.replace(true, num_points=np.array([5, 0, 5]))
    found = rows(track("a", 0.9, 0, 1, 2))
    figures = evaluate_tracking(found, true, true[np.zeros(0, np.int64)], frames(3), NUSCENES)
    assert figures.by_class["car"]["gt"] == 3
    assert figures.by_class["car"]["tp"] == 3


def test_recalls_that_are_not_reached() -> None:
    """One of two cars is found: recalls .1 to .5 are reached, 18 of 40 (.1 + .9 k / 39 up to k = 17).

    The others count as MOTAR 0 and MOTP 2 m.
    """
    true = track("t", math.nan, 0, 1) + track("u", math.nan, 0, 1, x=20.0)
    car = evaluate(true, track("a", 0.9, 0, 1, x=5.5), count=2).by_class["car"]
    assert car["amota"] == pytest.approx(18 / 40)
    assert car["amotp"] == pytest.approx((18 * 0.5 + 22 * 2.0) / 40)


def test_the_threshold_of_the_best_mota_is_taken() -> None:
    """A second true car is found only with a score of .2, as is a false track twice as long.

    With all boxes MOTA is 1 - 4/6; above .2 it is 1 - 2/6: recall is 4/6.
    """
    true = TRUE + track("u", math.nan, 0, 1, x=20.0)
    false = track("far", 0.2, 0, 1, 2, 3, x=35.0)
    car = evaluate(true, track("a", 0.9, 0, 1, 2, 3) + track("b", 0.2, 0, 1, x=20.0) + false).by_class["car"]
    assert car["mota"] == pytest.approx(1 - 2 / 6)
    assert (car["recall"], car["fp"]) == (pytest.approx(4 / 6), 0)


def test_a_class_of_which_nothing_is_found_has_the_worst_figures() -> None:
    car = evaluate(TRUE, track("far", 0.9, 0, 1, x=30.0)).by_class["car"]
    assert (car["amota"], car["amotp"], car["recall"], car["mota"]) == (0.0, 2.0, 0.0, 0.0)
    assert (car["ml"], car["fn"], car["faf"], car["tid"], car["lgd"]) == (1, 4, 500, 20, 20)
    assert math.isnan(car["fp"])  # nobody knows at which threshold


def test_classes_without_truth_do_not_count() -> None:
    figures = evaluate(TRUE, track("a", 0.9, 0, 1, 2, 3))
    assert figures.all_classes["amota"] == 1.0
    assert math.isnan(figures.by_class["bus"]["amota"])


def test_thresholds_lie_between_the_scores_of_matches() -> None:
    """Recall .1 needs the first of ten objects, .5 the fifth, 1 is not reached."""
    protocol = dataclasses.replace(NUSCENES, recalls=3)
    at = recall_thresholds(np.array([0.5, 0.9, 0.8, 0.7, 0.6, 0.4]), 10, protocol)
    assert math.isnan(at[0])
    assert at[1:] == pytest.approx([0.45, 0.9])  # recall .55 lies half-way between the fifth and the sixth


@given(st.lists(st.integers(0, 5), min_size=1, max_size=60), st.integers(0, 100))
def test_the_score_of_a_track_is_its_mean_to_the_last_digit(tracks: list[int], seed: int) -> None:
    """A threshold that is a track's score must keep the whole track."""
    identity, score = np.array(tracks), np.random.default_rng(seed).random(len(tracks)).round(1)
    expected = [np.mean(score[identity == each]) for each in identity]
    assert mean_scores(identity, score).tolist() == expected
