"""Camera exposure: brightness, exposure time and sensor noise."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True)
class CameraOptics:
    """Exposure settings of all cameras of a vehicle. The default is noise-free images of one instant.

    The readout time of a rolling shutter is `CameraRig.readout_s`.

    Raises:
        ValueError: a time, gain or noise is out of range.
    """

    exposure_ev: float = 0.0
    """Exposure in stops, relative to the metered exposure of the scene."""
    shutter_s: float = 0.0
    """Exposure time of each row, centred on its readout, s. 0 is an instant without motion blur."""
    sub_exposures: int = 8
    """Number of instants that are averaged if `shutter_s` is above 0."""
    white_electrons: float = math.inf
    """Electrons of a pixel with linear value 1, at gain 1. Infinity means no noise. Pixels of 3 µm hold about
    10 000."""
    read_noise_electrons: float = 0.0
    """Standard deviation of the readout noise in electrons, typically about 3."""
    gain: float = 1.0
    """Amplification, as ISO speed: g times fewer electrons give the same image."""

    def __post_init__(self) -> None:
        if self.shutter_s < 0 or self.sub_exposures < 1:
            raise ValueError(f"a shutter of {self.shutter_s:g} s in {self.sub_exposures} sub-exposures")
        if not (self.white_electrons > 0 and self.gain > 0 and self.read_noise_electrons >= 0):
            raise ValueError("electrons and gain lie above 0, read noise at 0 or above")

    @property
    def sub_exposure_dt_s(self) -> tuple[float, ...]:
        """Return the times of the sub-exposures, relative to the middle of the exposure, s."""
        count = self.sub_exposures
        return tuple(self.shutter_s * ((k + 0.5) / count - 0.5) for k in range(count))

    def with_noise(
        self, linear: Float32[np.ndarray, "*shape"], rng: np.random.Generator
    ) -> Float32[np.ndarray, "*shape"]:
        """Add photon noise and readout noise to linear values.

        A value x corresponds to n = x · white_electrons / gain electrons on average. Their number has
        standard deviation √n, and the readout adds noise of σ electrons. With w = white_electrons and g =
        gain, the variance of the result is x · g/w + (σ · g/w)² (the linear model of EMVA 1288 without dark
        current). The Poisson distribution is approximated by a normal one, as in Foi et al., "Practical
        Poissonian-Gaussian noise modeling", 2008.
        """
        if math.isinf(self.white_electrons):
            return linear
        # Shot noise grows with the square root of the light; both noises add as variances
        per_electron = np.float32(self.gain / self.white_electrons)
        read = np.float32(self.read_noise_electrons) * per_electron
        noise = rng.standard_normal(linear.shape, dtype=np.float32)
        noise *= np.sqrt(np.maximum(linear, 0.0) * per_electron + read * read)
        return np.maximum(linear + noise, 0.0)
