"""The rule of speeds: distances behind obstacles, lights and road users in the way, by hand."""

import numpy as np
import pytest

from foredrive.data.truth.affordances import PathAhead, path_ahead
from foredrive.driving.speed_rule import (
    DESIRED_MPS,
    MARGIN_M,
    STANDSTILL_M,
    Obstacle,
    PathView,
    curve_speed,
    drive_along,
    meets_somebody,
    must_stop,
    rule_progress,
    slowed_m,
)
from foredrive.geometry.polylines import arc_lengths
from foredrive.scene.affordances import CELLS, TIMES
from foredrive.scene.traffic_light import LightState

FRONT_M = 4.1


def path(xyz: np.ndarray | None = None) -> PathAhead:
    line = np.stack([np.arange(100.0), np.zeros(100), np.zeros(100)], -1) if xyz is None else xyz
    return path_ahead(line, arc_lengths(line), 0.0, np.eye(4), FRONT_M)


def nobody() -> np.ndarray:
    return np.zeros((TIMES, CELLS), dtype=bool)


def view(
    light: LightState = LightState.NONE, light_m: float = 0.0, occupied: np.ndarray | None = None
) -> PathView:
    return PathView(light, light_m, None, nobody() if occupied is None else occupied)


def test_it_speeds_up_to_its_speed_and_keeps_it() -> None:
    along = drive_along(path(), 0.0, [])
    assert (np.diff(along, prepend=0.0) > 0).all()
    assert along[-1] < DESIRED_MPS * 3
    cruising = np.diff(drive_along(path(), DESIRED_MPS, []), prepend=0.0)
    np.testing.assert_allclose(cruising, DESIRED_MPS * 0.5, rtol=0.02)
    np.testing.assert_array_equal(rule_progress(path(), 3.0, view()), drive_along(path(), 3.0, []))


@pytest.mark.parametrize("gap_m", [25.0, 18.0])
def test_it_stops_before_what_stands(gap_m: float) -> None:
    speed, done = DESIRED_MPS, 0.0
    for _ in range(30):  # plans anew every half second
        along = drive_along(path(), speed, [Obstacle(gap_m - done, 0.0)])
        speed, done = float(along[0]) / 0.5 if along[0] > 0.02 else 0.0, done + float(along[0])
    assert speed < 0.1
    assert gap_m - STANDSTILL_M - 1.5 < done < gap_m


def test_it_follows_at_the_speed_of_the_leader() -> None:
    along = drive_along(path(), 4.0, [Obstacle(8.0, 4.0)])
    assert np.diff(along)[-1] / 0.5 == pytest.approx(4.0, abs=0.6)


def test_it_slows_down_before_a_corner() -> None:
    turn = np.concatenate(
        [
            np.stack([np.arange(8.0), np.zeros(8)], -1),
            [[8, 1], [8, 2], [8, 3], [8, 4]],
            np.stack([np.full(30, 8.0), np.arange(5.0, 35.0)], -1),
        ]
    )
    corner = path(np.column_stack([turn, np.zeros(len(turn))]))
    assert curve_speed(corner) < 4.0 < DESIRED_MPS == curve_speed(path())


@pytest.mark.parametrize(
    ("light", "light_m", "speed_mps", "stops"),
    [
        (LightState.RED, 10.0, 8.0, True),  # 3.2 m/s²
        (LightState.RED, 4.0, 8.0, False),  # 8 m/s²: too late
        (LightState.RED, -2.0, 2.0, True),  # the tail is 2.4 m before the line
        (LightState.RED, -5.0, 2.0, False),  # it is beyond
        (LightState.YELLOW, 15.0, 8.0, True),  # 2.1 m/s²
        (LightState.YELLOW, 8.0, 8.0, False),  # 4 m/s²: it drives through
        (LightState.YELLOW, 8.0, 4.0, True),  # by the present speed, not by the desired one
        (LightState.GREEN, 10.0, 8.0, False),
        (LightState.NONE, 0.0, 0.0, False),
    ],
)
def test_lights_stop_who_can(light: LightState, light_m: float, speed_mps: float, stops: bool) -> None:
    assert must_stop(light, light_m, speed_mps) is stops


def test_beyond_the_line_it_waits_for_green() -> None:
    """Its front has passed the line, and its tail, which is judged, has not."""
    assert rule_progress(path(), 0.0, view(LightState.RED, -2.0))[-1] < 0.5
    assert rule_progress(path(), 0.0, view(LightState.GREEN, -2.0))[-1] > 4.0


def test_it_brakes_for_who_will_cross_and_drives_on_afterwards() -> None:
    """Somebody is 10 to 12 m ahead from 1 to 2 s: at 6 m/s the front bumper would be there."""
    occupied = nobody()
    occupied[2:5, 5] = True
    nominal = drive_along(path(), 6.0, [])
    slower = rule_progress(path(), 6.0, view(occupied=occupied))
    assert slower[3] < 10.0 - MARGIN_M < nominal[3]
    assert slower[-1] > slower[3] + 1.0 or slower[-1] < 10.0
    gone = nobody()
    gone[:2, 5] = True  # it has crossed before the vehicle comes
    np.testing.assert_array_equal(rule_progress(path(), 6.0, view(occupied=gone)), nominal)


def test_the_whole_length_of_the_vehicle_meets_and_a_standing_one_does_not() -> None:
    occupied = nobody()
    occupied[3:, 2] = True  # 4 to 6 m ahead from 1.5 s on
    t_s = 0.5 * np.arange(1, TIMES)
    assert meets_somebody(6.0 * t_s, occupied)
    assert not meets_somebody(np.zeros(len(t_s)), occupied)
    late = nobody()
    late[3, 2] = True  # at 9 m, the rear is at 4.1 m
    assert meets_somebody(6.0 * t_s, late)
    late[3], late[4, 2] = False, True  # at 12 m, it has passed
    assert not meets_somebody(6.0 * t_s, late)


def test_braking_is_kinematics() -> None:
    np.testing.assert_allclose(slowed_m(6.0, 2.0, 2.0, np.array([1.0, 2.0, 3.0])), [5.0, 8.0, 10.0])
