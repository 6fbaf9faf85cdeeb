"""Average precision of map elements: cases by hand wherever two protocols differ, invariants, parity."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tasks.map_scenes import elements, random_maps
from tasks.maps_by_hand import chamfer, points_of, precision

from foredrive.errors import InputError
from foredrive.scene.map_elements import ElementKind
from foredrive.tasks.maps.lines import CLASSES, LineSet, chamfer_distances, resample
from foredrive.tasks.maps.precision import average_precision_area, mean_precision, score_maps
from foredrive.tasks.maps.protocols import PROTOCOLS, Area

DIVIDER, CROSSING, BOUNDARY = CLASSES


def straight(y: float, start: float = -20.0, end: float = 20.0) -> list[tuple[float, float]]:
    return [(start, y), (end, y)]


def ap_at(predicted: LineSet, true: LineSet, name: str, area: Area = "60x30") -> tuple[float, ...]:
    return score_maps(predicted, true, PROTOCOLS[name], area)[DIVIDER].ap_at


def test_points_at_equal_distances() -> None:
    corner = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0]])
    np.testing.assert_allclose(resample(corner, 5), [[0, 0], [1, 0], [2, 0], [3, 0], [3, 1]])
    np.testing.assert_allclose(resample(corner, 57), points_of(corner, 57), atol=1e-12)


def test_chamfer_by_hand() -> None:
    """One point 1 m off, the other on the line: (0 + 1) / 2 there, and (0 + 1) / 2 back."""
    one, other = np.array([[[0.0, 0.0], [5.0, 1.0]]]), np.array([[[0.0, 0.0], [5.0, 0.0]]])
    np.testing.assert_allclose(chamfer_distances(one, other), [[0.5]])
    np.testing.assert_allclose(chamfer_distances(one, other + 40.0, at_most_m=2.0), [[np.inf]])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_pruned_pairs_are_far(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lines, others = (np.cumsum(rng.normal(0, 1, (4, 9, 2)), axis=1) for _ in range(2))
    whole = chamfer_distances(lines, others)
    pruned = chamfer_distances(lines, others, at_most_m=1.5)
    expected = [[chamfer(a, b) for b in others] for a in lines]
    np.testing.assert_allclose(whole, expected, atol=1e-9)
    np.testing.assert_array_equal(pruned[pruned < np.inf], whole[pruned < np.inf])
    assert (whole[pruned == np.inf] > 1.5).all()


def test_area_under_the_curve_by_hand() -> None:
    """Hit, false, hit of three objects: 1/3 · 1 + 1/3 · 2/3."""
    score, hit = np.array([0.9, 0.8, 0.7]), np.array([True, False, True])
    assert average_precision_area(score, hit, 3) == pytest.approx(1 / 3 + 2 / 9)
    assert average_precision_area(score, hit, 0) == 0.0
    assert average_precision_area(score[:0], hit[:0], 3) == 0.0


def test_a_taken_truth_is_not_replaced_by_the_second_nearest() -> None:
    """Two predictions are nearest to the same line; the other line, 0.45 m off, stays unfound."""
    true = elements([straight(0.0), straight(0.8)])
    predicted = elements([straight(0.0), straight(0.35)], score=[0.9, 0.8])
    for name in ("maptr", "streammapnet", "sparsedrive"):
        assert ap_at(predicted, true, name) == pytest.approx([0.5, 0.5, 0.5])


def test_buffers_that_do_not_touch() -> None:
    """Two short lines in a row with a gap of 0.5 m, which buffers with flat ends leave open.

    From 0 … 1 to 1.5 … 2.5 the nearest point is on average 1 m off, both ways.
    """
    true, predicted = elements([[(1.5, 0.0), (2.5, 0.0)]]), elements([[(0.0, 0.0), (1.0, 0.0)]])
    assert ap_at(predicted, true, "maptr") == (0.0, 0.0, 0.0)
    assert ap_at(predicted, true, "streammapnet") == (0.0, pytest.approx(1.0), 1.0)


def test_the_number_of_points_decides_at_the_edge() -> None:
    """60 m long, 0.45 m beside and 0.303 m further along, which is half of the distance between 100 points.

    Of 100 points the nearest is √(0.45² + 0.303²) = 0.54 m off, of 200 points 0.45 m.
    """
    true, predicted = elements([straight(0.0, -30.0, 30.0)]), elements([straight(0.45, -29.697, 30.303)])
    assert ap_at(predicted, true, "maptr") == (0.0, 1.0, 1.0)
    assert ap_at(predicted, true, "streammapnet") == (1.0, 1.0, 1.0)
    half = chamfer_distances(predicted.resampled(100), true.resampled(100))[0, 0]
    assert half == pytest.approx(math.hypot(0.45, 0.303), abs=0.005)


def test_the_larger_area_has_larger_distances_in_streammapnet_alone() -> None:
    true, predicted = elements([straight(0.0)]), elements([straight(1.8)])
    assert ap_at(predicted, true, "streammapnet", "60x30") == (0.0, 0.0, 0.0)
    assert ap_at(predicted, true, "streammapnet", "100x50") == (0.0, 0.0, 1.0)
    for name in ("maptr", "sparsedrive"):
        assert ap_at(predicted, true, name, "100x50") == (0.0, 0.0, 0.0)


def test_classes_without_truth() -> None:
    """Dividers are perfect, nothing else is true: left out, or 0 for each of the two other classes."""
    true = elements([straight(0.0)])
    predicted = elements([straight(0.0), straight(5.0)], kind=[DIVIDER, BOUNDARY], score=[0.9, 0.4])
    for name, expected in (("maptr", 1.0), ("streammapnet", 1 / 3), ("sparsedrive", 1 / 3)):
        protocol = PROTOCOLS[name]
        assert mean_precision(score_maps(predicted, true, protocol, "60x30"), protocol) == pytest.approx(
            expected
        )
    empty = score_maps(predicted, elements([]), PROTOCOLS["maptr"], "60x30")
    assert math.isnan(mean_precision(empty, PROTOCOLS["maptr"]))


def consistent(predicted: LineSet, true: LineSet, *, corrected: bool, **more: object) -> float:
    name = "maptracker_consistent" + "_corrected" * corrected
    return score_maps(predicted, true, PROTOCOLS[name], "60x30", **more)[DIVIDER].ap  # type: ignore[arg-type]


def test_a_changed_identity_is_false_in_consistent_map() -> None:
    """A line found in three frames as 7, 8, 7: the second is false, whatever its score."""
    true = elements([straight(0.0)] * 3, frame=[0, 1, 2], identity=[4, 4, 4])
    predicted = elements([straight(0.0)] * 3, frame=[0, 1, 2], score=[0.5, 0.9, 0.8], identity=[7, 8, 7])
    assert ap_at(predicted, true, "streammapnet") == (1.0, 1.0, 1.0)
    # false, hit, hit of three: precision 2/3 up to recall 2/3
    assert consistent(predicted, true, corrected=False) == pytest.approx(4 / 9)
    # in a drive of its own, identity 8 is the first
    drives = np.array([0, 1, 0])
    assert consistent(predicted, true, corrected=False, drive=drives) == pytest.approx(1.0)


def test_false_positives_in_frames_without_truth_are_dropped_as_released() -> None:
    """In the second frame nothing is true, and something is predicted with the largest score."""
    true = elements([straight(0.0)], identity=[1])
    predicted = elements([straight(0.0)] * 2, frame=[0, 1], score=[0.5, 0.9], identity=[1, 2])
    assert consistent(predicted, true, corrected=False) == pytest.approx(1.0)
    assert consistent(predicted, true, corrected=True) == pytest.approx(0.5)
    assert ap_at(predicted, true, "streammapnet") == pytest.approx((0.5, 0.5, 0.5))


def test_identities_are_checked() -> None:
    line = elements([straight(0.0)])
    twice = elements([straight(0.0), straight(3.0)], identity=[3, 3])
    protocol = PROTOCOLS["maptracker_consistent"]
    with pytest.raises(InputError, match=r"^predicted map elements have no identities, which C-mAP needs$"):
        score_maps(line, twice, protocol, "60x30")
    with pytest.raises(InputError, match=r"^frame 0 has predicted divider 3 twice: identities are unique"):
        score_maps(twice, elements([straight(0.0)], identity=[1]), protocol, "60x30")
    other = dataclasses.replace(twice, kind=np.array([DIVIDER, CROSSING]))
    assert score_maps(other, other, protocol, "60x30")[DIVIDER].ap == 1.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", list(PROTOCOLS))
def test_parity_with_a_literal_derivation(seed: int, name: str) -> None:
    predicted, true = random_maps(np.random.default_rng(seed))
    protocol = PROTOCOLS[name]
    drive = [0, 0, 1, 1, 1]
    scores = score_maps(predicted, true, protocol, "60x30", drive=np.array(drive))
    for kind in CLASSES:
        for limit_m, ap in zip(protocol.distances_m["60x30"], scores[kind].ap_at, strict=True):
            expected = precision(
                predicted,
                true,
                kind,
                limit_m,
                points=100 if name == "maptr" else 200,
                buffers=name == "maptr",
                consistent="consistent" in name,
                drive=drive,
                first_points=20 if "consistent" in name else None,
                drop=name == "maptracker_consistent",
            )
            assert ap == pytest.approx(expected, abs=1e-9)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000), angle=st.floats(-3, 3), name=st.sampled_from(list(PROTOCOLS)))
def test_moving_and_shuffling_everything_changes_nothing(seed: int, angle: float, name: str) -> None:
    rng = np.random.default_rng(seed)
    predicted, true = random_maps(rng, frames=3)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    moved = [
        dataclasses.replace(e, lines=[line @ turn + (3.0, -7.0) for line in e.lines])[
            rng.permutation(len(e.lines))
        ]
        for e in (predicted, true)
    ]
    before = score_maps(predicted, true, PROTOCOLS[name], "60x30")
    after = score_maps(*moved, PROTOCOLS[name], "60x30")
    for kind in CLASSES:
        assert after[kind].ap_at == pytest.approx(before[kind].ap_at, abs=1e-9)


@pytest.mark.parametrize("name", list(PROTOCOLS))
def test_perfect_maps(name: str) -> None:
    _, true = random_maps(np.random.default_rng(5), frames=8)
    for score in score_maps(true, true, PROTOCOLS[name], "60x30").values():
        assert score.ap == pytest.approx(1.0)
        assert score.true == score.predicted > 0


def test_centrelines_are_a_class_of_their_own() -> None:
    line = elements([straight(0.0)], kind=ElementKind.CENTRELINE)
    scores = score_maps(line, line, PROTOCOLS["maptr"], "60x30", classes=[*CLASSES, ElementKind.CENTRELINE])
    assert scores[ElementKind.CENTRELINE].ap == 1.0
    assert mean_precision(scores, PROTOCOLS["maptr"]) == 1.0
