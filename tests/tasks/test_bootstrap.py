"""Bootstrap intervals and p-values."""

import math

import numpy as np
import pytest

from foredrive.errors import InputError
from foredrive.tasks.bootstrap import bootstrap_mean


def test_bootstrap_draws_whole_sequences() -> None:
    """Ten sequences of fifty equal frames: the interval is that of ten values, not of five hundred."""
    rng = np.random.default_rng(4)
    level = rng.normal(1.0, 1.0, 10)
    names = [f"s{n}" for n in range(10) for _ in range(50)]
    result = bootstrap_mean(np.repeat(level, 50), names, rng)
    assert result.mean == pytest.approx(level.mean())
    half = 1.96 * level.std() / math.sqrt(10)
    assert (result.high - result.low) / 2 == pytest.approx(half, rel=0.15)
    assert result.low < result.mean < result.high


def test_a_long_sequence_weighs_as_many_frames_as_it_has() -> None:
    """Thirty sequences of one frame of 0, and thirty of 99 frames of 1."""
    names = [f"short{n}" for n in range(30)] + [f"long{n}" for n in range(30) for _ in range(99)]
    values = np.concatenate([np.zeros(30), np.ones(30 * 99)])
    result = bootstrap_mean(values, names, np.random.default_rng(0))
    assert result.mean == pytest.approx(0.99)
    assert 0.95 < result.low < result.mean < result.high


def test_p_values_are_small_where_the_mean_is_far_from_0() -> None:
    rng = np.random.default_rng(5)
    names = [str(n) for n in range(40)]
    assert bootstrap_mean(rng.normal(1.0, 1.0, 40), names, rng).p_value < 0.01
    values = rng.normal(0.0, 1.0, 40)
    assert bootstrap_mean(values - values.mean(), names, rng).p_value > 0.5
    few = bootstrap_mean(np.ones(30), ["a", "b", "c"] * 10, rng)
    assert few.p_value == pytest.approx(2 * 0.5**3, abs=0.05)  # however many frames: all signs alike
    assert bootstrap_mean(np.zeros(30), ["a", "b", "c"] * 10, rng).p_value == 1.0
    one = bootstrap_mean(np.ones(3), ["a"] * 3, rng)
    assert one.mean == 1.0
    assert math.isnan(one.low)
    with pytest.raises(InputError, match="finite"):
        bootstrap_mean(np.array([np.inf]), ["a"], rng)
