"""What a camera makes of light: exposure, the time it takes, and the noise of its sensor."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True)
class CameraOptics:
    """Exposure of all cameras of a vehicle; by default clean images of one instant.

    How long a rolling shutter takes from the first row to the last is `CameraRig.readout_s`.
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

    @property
    def sub_exposure_dt_s(self) -> tuple[float, ...]:
        """Times of the sub-exposures relative to the middle of the exposure."""
        count = self.sub_exposures
        return tuple(self.shutter_s * ((k + 0.5) / count - 0.5) for k in range(count))

    def with_noise(
        self, linear: Float32[np.ndarray, "*shape"], rng: np.random.Generator
    ) -> Float32[np.ndarray, "*shape"]:
        """Linear values with the sensor's noise: photons arrive at random, and the readout errs.

        A value x is x · white_electrons / gain electrons n on average; n is Poisson distributed and the
        readout adds normal noise of σ electrons, so that the variance of the result is
        x · g/w + (σ · g/w)² (EMVA 1288, eq. 8, without dark current).
        """
        if math.isinf(self.white_electrons):
            return linear
        electrons = np.float32(self.white_electrons / self.gain)
        read = np.float32(self.read_noise_electrons) * rng.standard_normal(linear.shape, dtype=np.float32)
        counted = rng.poisson(np.maximum(linear, 0.0) * electrons) + read
        return np.maximum(counted / electrons, 0.0).astype(np.float32)
