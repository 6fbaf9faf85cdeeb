"""HUGSIM's HD-Score of plans drawn by hand."""

import dataclasses
import math

import numpy as np
import pytest
import shapely

from foredrive.driving.ncap.hd import PlanInTraffic, hd_score
from foredrive.errors import InputError

ROAD = shapely.box(-20.0, -4.0, 200.0, 4.0)
SIZE = (4.8, 2.0)


def plan(speed_mps: float = 8.0, *others: shapely.Polygon, y: float = 0.0) -> PlanInTraffic:
    xy = np.stack([speed_mps * 0.5 * np.arange(7), np.full(7, y)], axis=1)
    return PlanInTraffic(xy, np.zeros(7), 0.5, (tuple(others),) * 7)


def car(x: float, y: float = 0.0) -> shapely.Polygon:
    return shapely.box(x - 2.0, y - 1.0, x + 2.0, y + 1.0)


def test_by_hand() -> None:
    """One perfect plan, and one that would hit somebody within 1 s: (1 + 2 / 7) / 2, and 80 % of the route.

    At 8 m/s the last pose is at 24 m, its bumper at 26.4 m, and 1 s later at 34.4 m.
    """
    found = hd_score([plan(), plan(8.0, car(36.0))], ROAD, SIZE, completion=0.8)
    assert (found.nc, found.dac, found.ttc, found.comfort) == (1.0, 1.0, 0.5, 1.0)
    assert found.hd_score == pytest.approx(0.8 * (1 + 2 / 7) / 2)
    assert hd_score([plan(8.0, car(36.5))], ROAD, SIZE, 1.0).ttc == 1.0
    hit = hd_score([plan(8.0, car(27.0))], ROAD, SIZE, 1.0)
    assert (hit.nc, hit.hd_score) == (0.0, 0.0)


def test_less_than_half_of_the_vehicle_on_the_road_is_off_it() -> None:
    """The middles of its quarters lie 0.5 m to each side."""
    for y, expected in ((3.4, 1.0), (4.4, 1.0), (4.6, 0.0)):
        assert hd_score([plan(y=y)], ROAD, SIZE, 1.0).dac == expected, y


def test_comfort_bounds() -> None:
    starts = dataclasses.replace(
        plan(), xy_m=np.array([[0, 0], [0, 0], [1, 0], [4, 0], [9, 0], [16, 0], [25, 0]], float)
    )
    assert hd_score([starts], ROAD, SIZE, 1.0).comfort == 0.0
    turns = dataclasses.replace(plan(), yaw_rad=0.5 * np.arange(7) + 3.0)
    assert hd_score([turns], ROAD, SIZE, 1.0).comfort == 0.0
    wraps = dataclasses.replace(
        plan(), yaw_rad=np.remainder(3.0 + 0.1 * np.arange(7) + math.pi, 2 * math.pi) - math.pi
    )
    assert hd_score([wraps], ROAD, SIZE, 1.0).comfort == 1.0


def test_headings_of_a_plan_that_stands_do_not_turn_the_vehicle() -> None:
    still = dataclasses.replace(plan(0.1, car(0.0, 3.2)), yaw_rad=np.linspace(0, math.pi / 2, 7))
    assert hd_score([still], ROAD, SIZE, 1.0).nc == 1.0


def test_without_plans_there_is_no_score() -> None:
    with pytest.raises(InputError, match="at least one plan"):
        hd_score([], ROAD, SIZE, 1.0)
