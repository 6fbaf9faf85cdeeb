"""Learning rates by hand."""

import math

import pytest

from foredrive.engine.learning_rates import Rate


def test_a_rate_decays_from_the_first_step_to_the_last() -> None:
    rate = Rate(1e-2, final=0.01)
    assert [rate.at(step, 100) for step in (0, 50, 100)] == pytest.approx([1e-2, 1e-3, 1e-4])


def test_a_rate_warms_up_as_a_sine_and_stays_after_its_last_step() -> None:
    rate = Rate(1e-3, final=0.1, warmup_steps=20, until_step=60)
    steps = (0, 10, 20, 40, 60, 99)
    expected = [0.0, 1e-3 * math.sqrt(0.5), 1e-3, 1e-3 * math.sqrt(0.1), 1e-4, 1e-4]
    assert [rate.at(step, 100) for step in steps] == pytest.approx(expected)


def test_a_rate_of_zero_stays_zero() -> None:
    assert Rate(0.0).at(7, 10) == 0.0
