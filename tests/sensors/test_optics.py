"""Exposure and noise of cameras."""

import numpy as np
import pytest

from foredrive.sensors import CameraOptics


def test_noise_follows_the_photons() -> None:
    optics = CameraOptics(white_electrons=8000.0, read_noise_electrons=5.0, gain=4.0)
    for value in (0.02, 0.2, 0.9):
        noisy = optics.with_noise(np.full(200_000, value, np.float32), np.random.default_rng(1))
        electron = 4.0 / 8000.0
        assert noisy.mean() == pytest.approx(value, rel=3e-3)
        assert noisy.var() == pytest.approx(value * electron + (5.0 * electron) ** 2, rel=0.03)


def test_no_noise_by_default_and_the_same_noise_from_one_seed() -> None:
    linear = np.linspace(0.0, 2.0, 100, dtype=np.float32)
    assert CameraOptics().with_noise(linear, np.random.default_rng(0)) is linear
    optics = CameraOptics(white_electrons=1000.0)
    a, b = (optics.with_noise(linear, np.random.default_rng(7)) for _ in range(2))
    assert a.tobytes() == b.tobytes()
    assert (a >= 0).all()
    assert a[0] == 0.0  # no light, no photons


def test_sub_exposures_fill_the_shutter_time() -> None:
    times = CameraOptics(shutter_s=0.02, sub_exposures=4).sub_exposure_dt_s
    assert times == pytest.approx((-0.0075, -0.0025, 0.0025, 0.0075))


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="0 sub-exposures"):
        CameraOptics(shutter_s=0.01, sub_exposures=0)
    with pytest.raises(ValueError, match="above 0"):
        CameraOptics(gain=0.0)
