"""What is remembered of stop signs."""

import numpy as np
import pytest

from foredrive.data.truth.affordances import PASSED_M
from foredrive.driving.stop_signs import PATIENCE, UNSEEN, StopSigns
from foredrive.scene.affordances import CELL_M, CELLS, TIMES


def driven(signs: StopSigns, line_m: float, to_m: float, speed_mps: float, seen: bool = True) -> float | None:
    """Drive from one distance of the line to another, half a second at a time, and return the last answer."""
    answer, moved_m = None, 0.0
    while True:
        answer = signs.update(line_m if seen else None, moved_m, speed_mps)
        moved_m = min(0.5 * speed_mps, line_m - to_m)
        if moved_m <= 0:
            return answer
        line_m -= moved_m


def test_it_stops_the_vehicle_until_it_has_stood_at_the_line() -> None:
    signs = StopSigns()
    assert driven(signs, 30.0, 3.0, 6.0) == pytest.approx(3.0)
    assert signs.update(None, 0.0, 3.0) == pytest.approx(3.0)  # near the line it is out of view
    assert signs.update(None, 0.0, 0.05) is None
    assert signs.update(3.0, 0.0, 0.0) is None  # a reading of the same line
    assert driven(signs, 3.0, -PASSED_M, 2.0, seen=False) is None
    assert signs.update(25.0, 1.0, 5.0) == 25.0  # the next one


def test_standing_far_from_the_line_is_no_stop() -> None:
    signs = StopSigns()
    assert signs.update(12.0, 0.0, 0.0) == 12.0  # behind a queue
    assert signs.update(12.0, 0.0, 0.0) == 12.0


def test_a_line_that_was_crossed_stops_nobody() -> None:
    signs = StopSigns()
    assert driven(signs, 10.0, 2.0, 8.0) is not None
    assert signs.update(None, 4.0, 8.0) is None


def test_one_that_is_not_seen_again_is_forgotten() -> None:
    signs = StopSigns()
    answers = [signs.update(20.0, 0.0, 5.0), *(signs.update(None, 1.0, 5.0) for _ in range(UNSEEN))]
    assert answers[:2] == [20.0, 19.0]
    assert answers[-1] is None


def test_a_single_reading_does_not_count_where_two_are_asked() -> None:
    signs = StopSigns(confirmed=2)
    assert signs.update(20.0, 0.0, 5.0) is None
    assert signs.update(9.0, 2.5, 5.0) is None  # elsewhere
    assert signs.update(7.5, 2.5, 5.0) == pytest.approx(7.0)  # between the two readings of one place


def test_a_sign_behind_the_next_one_waits() -> None:
    signs = StopSigns()
    assert signs.update(8.0, 0.0, 5.0) == 8.0
    assert signs.update(40.0, 2.0, 5.0) == 6.0


def crossed(*places_m: float) -> np.ndarray:
    """Return who is on the path in three seconds, by distances from the front bumper."""
    occupied = np.zeros((TIMES, CELLS), bool)
    for place_m in places_m:
        occupied[6, int(place_m / CELL_M)] = True
    return occupied


def test_who_has_stood_gives_way_to_those_who_cross_behind_the_line() -> None:
    signs = StopSigns()
    assert signs.update(3.0, 0.0, 0.0, crossed(9.0)) == 3.0
    assert signs.update(3.0, 0.0, 0.0, crossed(9.0)) == 3.0
    assert signs.update(3.0, 0.0, 0.0, crossed(1.0, 25.0)) is None  # before the line, and far beyond
    assert signs.update(2.5, 0.5, 1.0, crossed(9.0)) is None  # who drives already is not stopped again
    patient = StopSigns()
    answers = [patient.update(3.0, 0.0, 0.0, crossed(9.0)) for _ in range(PATIENCE + 1)]
    assert answers == [3.0] * PATIENCE + [None]
