"""The command is read from the route alone."""

import numpy as np
import pytest
from jaxtyping import Float64

from foredrive.data.commands import LATERAL_M, route_ahead, route_offset_m
from foredrive.scene.clip import TARGET


def arc_m(xy: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.linalg.norm(np.diff(xy, axis=0), axis=1).cumsum()])


def along(heading_rad: float, turn_m: float, turned_rad: float) -> np.ndarray:
    """A route of 100 m, a point per metre, that turns after `turn_m`."""
    heading = np.where(np.arange(100) < turn_m, heading_rad, heading_rad + turned_rad)
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


@pytest.mark.parametrize("heading_rad", [0.0, 2.0, -3.0])
@pytest.mark.parametrize("side", [1, -1])
def test_a_turn_is_as_far_aside_as_it_is_driven(heading_rad: float, side: int) -> None:
    route = along(heading_rad, 50.0, side * np.pi / 2)
    expected = {20.0: 0.0, 30.0: 0.0, 31.5: 1.5, 40.0: 10.0, 49.0: 19.0, 52.0: 0.0}
    for progress_m, aside_m in expected.items():
        assert route_offset_m(arc_m(route), route, progress_m) == pytest.approx(side * aside_m, abs=1e-6)


@pytest.mark.parametrize("progress_m", [0.0, 0.4, 95.0, 100.0])
def test_a_route_that_begins_or_ends_is_straight(progress_m: float) -> None:
    route = along(1.0, 200.0, 0.0)
    assert route_offset_m(arc_m(route), route, progress_m) == pytest.approx(0.0, abs=1e-9)


def test_jitter_of_the_points_is_no_turn() -> None:
    route = along(0.5, 200.0, 0.0) + np.random.default_rng(0).normal(scale=0.03, size=(101, 2))
    arc = arc_m(route)
    assert max(abs(route_offset_m(arc, route, p)) for p in np.arange(0, 80, 0.7)) < LATERAL_M


@pytest.mark.parametrize("heading_rad", [0.0, 2.0, -3.0])
def test_the_target_is_seen_from_the_vehicle_wherever_it_stands(heading_rad: float) -> None:
    """The route goes 50 m straight on, then left; the vehicle is 30 m along it, 2 m to its right."""
    route = along(heading_rad, 50.0, np.pi / 2)
    forward = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    T = np.eye(4)
    T[:2, 0], T[:2, 1] = forward, [-forward[1], forward[0]]
    T[:2, 3] = 30.0 * forward - 2.0 * T[:2, 1]

    def points(progress_m: float, pose: Float64[np.ndarray, "4 4"] = T) -> list[list[float]]:
        return route_ahead(arc_m(route), route, progress_m, pose).xy[[0, 3, TARGET]].round(9).tolist()

    assert points(30.0) == [[2.0, 2.0], [15.0, 2.0], [20.0, 2.0]]
    assert points(36.0) == [[8.0, 2.0], [20.0, 3.0], [20.0, 8.0]]
    assert points(99.0) == [[20.0, 52.0]] * 2 + [[20.0, 52.0]]  # its end
    turned = T.copy()
    turned[:2, 0], turned[:2, 1] = T[:2, 1], -T[:2, 0]  # it faces left
    assert points(30.0, turned) == [[2.0, -2.0], [2.0, -15.0], [2.0, -20.0]]
    valid = [route_ahead(arc_m(route), route, p, T).valid.tolist() for p in (30.0, 80.0, 99.9)]
    assert valid == [[True] * 7, [True] * 5 + [False] * 2, [True] + [False] * 6]
