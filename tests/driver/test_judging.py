"""Figures of what a driver sees, counted by hand."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from path_truth import sight_of, truth

from foredrive.driver.judging import THRESHOLDS, Moment, _figures, _moment, uncertainty
from foredrive.scene.affordances import TIMES, PathEstimate
from foredrive.scene.traffic_light import LightState

PLAIN = Moment(
    state=LightState.NONE,
    named=LightState.NONE,
    light_m=0.0,
    light_error_m=0.0,
    visible=False,
    lit=True,
    sign_m=math.inf,
    sign_seen_m=math.inf,
    first=-1,
    first_seen=np.full(len(THRESHOLDS), -1.0),
    conflict=False,
    conflict_seen=np.zeros(len(THRESHOLDS), dtype=bool),
    crossing=False,
)


def light(state: LightState, named: LightState, light_m: float = 20.0, visible: bool = True) -> Moment:
    return PLAIN._replace(state=state, named=named, light_m=light_m, light_error_m=2.0, visible=visible)


def conflict(probability: float, true: bool, crossing: bool = False) -> Moment:
    seen = np.array([probability >= threshold for threshold in THRESHOLDS])
    return PLAIN._replace(conflict=true, conflict_seen=seen, crossing=crossing)


def obstacle(first: int, first_seen: int) -> Moment:
    return PLAIN._replace(first=first, first_seen=np.full(len(THRESHOLDS), float(first_seen)))


def test_lights_within_forty_metres_whose_lamps_are_seen_are_counted() -> None:
    red, green, yellow, none = LightState.RED, LightState.GREEN, LightState.YELLOW, LightState.NONE
    figures = _figures(
        [
            light(red, red),
            light(red, yellow),  # wrong, but it stops
            light(red, none),  # missed
            light(green, green),
            light(green, red),
            light(red, green, light_m=45.0),  # too far
            light(red, green, visible=False),
            light(none, red),
        ]
    )
    assert figures["lights"] == 5
    assert figures["light_accuracy_40m"] == pytest.approx(2 / 5)
    assert figures["red_missed_40m"] == pytest.approx(1 / 3)
    assert figures["green_stopped_40m"] == pytest.approx(1 / 2)
    assert figures["none_stopped"] == 1.0
    assert figures["light_error_m"] == 2.0


def test_stop_signs_are_seen_if_their_line_is_about_where_it_is() -> None:
    pairs = [(12.0, 15.0), (12.0, 17.0), (12.0, math.inf), (1.0, math.inf), (40.0, math.inf)]
    pairs += [(math.inf, math.inf), (math.inf, 8.0), (math.nan, 8.0)]
    figures = _figures([PLAIN._replace(sign_m=true_m, sign_seen_m=seen_m) for true_m, seen_m in pairs])
    assert figures["sign_recall_30m"] == pytest.approx(1 / 3)  # one is under the image, one too far
    assert figures["sign_false"] == 0.5
    assert figures["signs"] == 3


def test_recall_counts_at_the_threshold_that_is_seldom_wrong() -> None:
    """Of ten free moments one has 0.65 and one 0.35: at 0.4 a tenth is false, at 0.3 a fifth."""
    free = [conflict(p, true=False) for p in (0.65, 0.35, *[0.1] * 8)]
    met = [conflict(0.9, true=True), conflict(0.45, true=True, crossing=True), conflict(0.25, true=True)]
    figures = _figures(free + met)
    assert figures["threshold"] == 0.4
    assert figures["conflict_false"] == pytest.approx(0.1)
    assert figures["conflict_recall"] == pytest.approx(2 / 3)
    assert figures["crossing_recall"] == 1.0
    assert (figures["conflicts"], figures["crossings"], figures["frames"]) == (3, 1, 13)


def test_the_error_of_the_first_obstacle_counts_a_missed_one_as_the_rest_of_the_way() -> None:
    figures = _figures([obstacle(3, 4), obstacle(5, 5), obstacle(10, -1), obstacle(20, 1), obstacle(-1, 2)])
    assert figures["first_obstacle_error_m"] == 2.0  # of 2, 0 and 10 m; the fourth is too far
    assert figures["first_obstacle_missed"] == pytest.approx(1 / 3)
    assert figures["first_obstacle_false"] == 1.0
    assert math.isnan(figures["conflict_recall"])


def test_a_clip_is_missed_if_the_driver_would_act_wrongly() -> None:
    red, green, yellow = LightState.RED, LightState.GREEN, LightState.YELLOW
    assert light(red, green).missed
    assert not light(red, yellow).missed
    assert light(green, red).missed
    assert not light(red, green, light_m=45.0).missed
    assert conflict(0.45, true=True).missed
    assert not conflict(0.55, true=True).missed
    assert not conflict(0.9, true=False).missed


@pytest.mark.parametrize(("light", "met"), [(LightState.RED, False), (LightState.GREEN, True)])
def test_who_is_met_beyond_a_red_light_is_no_conflict(light: LightState, met: bool) -> None:
    """The line is 5 m ahead; somebody is 8 to 10 m ahead from one second on. The vehicle has 6 m/s."""
    seen = truth(1)[0]
    path = torch.stack([torch.arange(72.0), torch.zeros(72)], dim=-1)
    seen = dataclasses.replace(
        seen,
        path_xy=path,
        path_valid=torch.ones(72, dtype=torch.bool),
        light=torch.tensor(int(light)),
        lead_known=torch.tensor(False),
    )
    nothing = sight_of(1).estimate()[0]
    moment = _moment(seen, nothing, 6.0, visible=True, sign_seen_m=math.inf)
    assert (moment.conflict, moment.crossing) == (met, met)


def test_the_uncertainty_of_an_estimate_by_hand() -> None:
    """Two clips: sure of all, and of nothing but that half of the cells are free."""
    light = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.25, 0.25, 0.25, 0.25]])
    occupied = torch.zeros(2, TIMES, 24)
    occupied[0, :, 3] = 1.0
    occupied[1, :, :12] = 0.5
    unsure = uncertainty(PathEstimate(light, torch.zeros(2), occupied))
    # A uniform light is 1, and half of the cells at a half are 0.5
    torch.testing.assert_close(unsure, torch.tensor([0.0, 1.5]), atol=1e-4, rtol=0)
    skewed = uncertainty(PathEstimate(torch.tensor([[0.5, 0.5, 0.0, 0.0]]), torch.zeros(1), occupied[:1]))
    torch.testing.assert_close(skewed, torch.tensor([0.5]), atol=1e-4, rtol=0)
