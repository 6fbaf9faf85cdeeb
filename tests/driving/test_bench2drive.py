"""Bench2Drive's metrics: parity with its tool, and cases computed by hand."""

import math

import numpy as np
import pytest
import torch

from foredrive.driving.bench2drive import (
    Bench2DriveDrive,
    EfficiencyMeter,
    bench2drive_figures,
    smooth_pieces,
    smoothness_of,
    succeeds,
)
from foredrive.driving.dynamics import EGO
from foredrive.driving.scores import Ending, Infraction, InfractionKind, RouteScore
from foredrive.scene import Attribute, BicycleState, Boxes, Category
from foredrive.scene.boxes import unlabelled

PUBLISHED = [1.0, 0.4, 0.4, 0.2, 1.0, 1.0, 0.6, 0.0, 1.0, 1.0, 0.4, 0.0]
"""By seed: `seg_compute_comfort_metric` of tools/efficiency_smoothness_benchmark.py at 7ec25d1."""


@pytest.mark.parametrize("seed", range(len(PUBLISHED)))
def test_smoothness_is_that_of_the_tool(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = (0.3, 1, 2, 4)[seed % 4]
    along, aside, turn = (np.cumsum(rng.normal(0, 0.1 * size, 100)) for _ in range(3))
    assert np.mean(smooth_pieces(along, aside, turn)) == pytest.approx(PUBLISHED[seed])


def states(speed: list[float], turn_rate: float = 0.0) -> list[BicycleState]:
    return [
        BicycleState(0.0, 0.0, 0.0, v, math.atan(EGO.wheelbase_m * turn_rate / v) if v else 0.0)
        for v in speed
    ]


def test_smoothness_of_a_drive() -> None:
    assert smoothness_of(states([5.0] * 20)) is None  # 19 steps
    assert smoothness_of(states([5.0] * 61)) == 100.0
    # 0.01 rad/s is 0.57 degrees per second and smooth, 0.02 rad/s is 1.15 and not
    assert smoothness_of(states([5.0] * 61, 0.01)) == 100.0
    assert smoothness_of(states([5.0] * 61, 0.02)) == 0.0
    # Braking at 6 m/s² in the second of three pieces
    speed = [12.0] * 21 + [12.0 - 0.3 * k for k in range(1, 21)] + [6.0] * 20
    assert smoothness_of(states(speed)) == pytest.approx(200 / 3)


PARKED = 0.0


def boxes(*users: tuple[Category, float]) -> Boxes:
    count = len(users)
    without_attribute = unlabelled(count)
    parked = torch.tensor([Attribute.VEHICLE_PARKED if v == PARKED else -1 for _, v in users])
    return Boxes(
        centre=torch.zeros(count, 3),
        size_lwh=torch.ones(count, 3),
        yaw=torch.zeros(count),
        velocity=torch.tensor([[0.6 * v, 0.8 * v] for _, v in users]).reshape(-1, 2),
        track_id=torch.arange(count),
        category=torch.tensor([int(kind) for kind, _ in users], dtype=torch.long),
        valid=torch.ones(count, dtype=torch.bool),
        **(without_attribute | {"attribute": parked.long()}),
    )


def test_efficiency_is_the_speed_beside_the_traffics() -> None:
    meter, car, walker = EfficiencyMeter(), Category.CAR, Category.PEDESTRIAN
    meter.see(4.0, boxes((car, 4.0), (car, 8.0), (walker, 1.0), (car, PARKED)), 0.02)  # traffic 6 m/s
    meter.see(8.0, boxes((car, 6.0), (car, math.nan)), 0.04)
    meter.see(3.0, boxes((car, 0.1)), 0.06)  # ends the first part: 6 of 6 m/s
    meter.see(3.0, boxes((walker, 1.0)), 0.12)  # ends the second: 3 of 0.1 m/s, which does not count
    assert meter.parts_pct == pytest.approx([100.0, 3000.0])
    assert meter.result(0.12) == pytest.approx(100.0)
    meter.see(2.0, boxes((car, 8.0)), 0.99)  # the third had no traffic: 100
    assert meter.result(1.0) == pytest.approx((100 + 100 + 25) / 3)
    assert EfficiencyMeter().result(0.3) is None


def score(ending: Ending = Ending.COMPLETED, outside: float = 0.0, *kinds: InfractionKind) -> RouteScore:
    infractions = tuple(Infraction(kind, 1.0, (0.0, 0.0)) for kind in kinds)
    return RouteScore("a", 0, 1.0, outside, ending, infractions, 100.0, 20.0)


def test_success_is_a_whole_route_without_infraction() -> None:
    assert succeeds(score())
    assert succeeds(score(Ending.COMPLETED, 0.0, InfractionKind.MIN_SPEED))
    assert not succeeds(score(Ending.TIMEOUT))
    assert not succeeds(score(Ending.COMPLETED, 0.01))
    assert not succeeds(score(Ending.COMPLETED, 0.0, InfractionKind.STOP_SIGN))


def test_figures_of_a_suite() -> None:
    drives = [
        Bench2DriveDrive(True, 120.0, 50.0, frozenset({"cut_in", "lead_brakes"})),
        Bench2DriveDrive(False, None, 100.0, frozenset({"cut_in"})),
        Bench2DriveDrive(False, 60.0, None, frozenset()),
    ]
    figures = bench2drive_figures(drives)
    assert figures["success_pct"] == pytest.approx(100 / 3)
    assert (figures["efficiency_pct"], figures["smoothness_pct"]) == (90.0, 75.0)
    assert (figures["ability.merging_pct"], figures["ability.merging_drives"]) == (50.0, 2)
    assert (figures["ability.emergency_brake_pct"], figures["ability.emergency_brake_drives"]) == (100.0, 1)
    assert (figures["ability.traffic_signs_pct"], figures["ability.traffic_signs_drives"]) == (None, 0)
