"""What a camera makes of light: exposure, the time it takes, and the noise of its sensor."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True)
class CameraOptics:
    """Exposure of all cameras of a vehicle; by default clean images of one instant.

    How long a rolling shutter takes from the first row to the last is `CameraRig.readout_s`.

    Raises:
        ValueError: a time, gain or noise that cannot be.
    """

    exposure_ev: float = 0.0
    """Stops above the exposure that the scene is metered at."""
    shutter_s: float = 0.0
    """How long each row is exposed, about the time of its readout; 0: an instant, nothing is blurred."""
    sub_exposures: int = 8
    """Instants that are averaged where `shutter_s` is above 0."""
    white_electrons: float = math.inf
    """Electrons of a pixel whose linear value is 1, at gain 1; infinite: no noise. Pixels of 3 µm hold about
    10 000."""
    read_noise_electrons: float = 0.0
    """Standard deviation of what the readout adds, about 3."""
    gain: float = 1.0
    """Amplification, as of ISO speed: so many times fewer electrons make the same picture."""

    def __post_init__(self) -> None:
        if self.shutter_s < 0 or self.sub_exposures < 1:
            raise ValueError(f"a shutter of {self.shutter_s:g} s in {self.sub_exposures} sub-exposures")
        if not (self.white_electrons > 0 and self.gain > 0 and self.read_noise_electrons >= 0):
            raise ValueError("electrons and gain lie above 0, read noise at 0 or above")

    @property
    def sub_exposure_dt_s(self) -> tuple[float, ...]:
        """Times of the sub-exposures relative to the middle of the exposure."""
        count = self.sub_exposures
        return tuple(self.shutter_s * ((k + 0.5) / count - 0.5) for k in range(count))

    def with_noise(
        self, linear: Float32[np.ndarray, "*shape"], rng: np.random.Generator
    ) -> Float32[np.ndarray, "*shape"]:
        """Linear values with the sensor's noise: photons arrive at random, and the readout errs.

        A value x is n = x · white_electrons / gain electrons on average. Their number varies by √n, the
        readout adds σ electrons: with w = white_electrons and g = gain the variance of the result is
        x · g/w + (σ · g/w)² (the linear model of EMVA 1288 without dark current). Normal numbers stand for
        Poisson's, as in Foi et al., "Practical Poissonian-Gaussian noise modeling", 2008.
        """
        if math.isinf(self.white_electrons):
            return linear
        per_electron = np.float32(self.gain / self.white_electrons)
        read = np.float32(self.read_noise_electrons) * per_electron
        noise = rng.standard_normal(linear.shape, dtype=np.float32)
        noise *= np.sqrt(np.maximum(linear, 0.0) * per_electron + read * read)
        return np.maximum(linear + noise, 0.0)
