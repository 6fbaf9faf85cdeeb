"""Images and sweeps that a scene renders."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor


@dataclass(frozen=True)
class RenderedImage:
    """A rendered image."""

    rgb: Float[Tensor, "3 H W"]
    """RGB, not clamped."""
    range_m: Float[Tensor, "H W"]
    """Expected depth along the camera's axis of the stopped light, m."""
    alpha: Float[Tensor, "H W"]

    @property
    def rgb_8bit(self) -> UInt8[Tensor, "3 H W"]:
        """Return RGB from 0 to 255, on the CPU."""
        return (255 * self.rgb.clamp(0, 1)).round().to(torch.uint8).cpu()


@dataclass(frozen=True)
class RenderedSweep:
    """A rendered sweep, beam by beam."""

    range_m: Float[Tensor, "P"]
    # Lost beams have range 0
    """Expected range of the stopped light, m."""
    median_range_m: Float[Tensor, "P"]
    """Median range, m; infinite where less than half of the light was stopped. Without gradient."""
    intensity: Float[Tensor, "P"]
    drop_logit: Float[Tensor, "P"]
    """Logit of the probability that the beam does not return."""
    alpha: Float[Tensor, "P"]
    alpha_before_hit: Float[Tensor, "P"] | None
    """See `Composited`."""

    @property
    def weighted_range_m(self) -> Float[Tensor, "P"]:
        """Return Σ weight · range: the expected range, not divided by alpha."""
        return self.range_m * self.alpha

    @property
    def hit_range_m(self) -> Float[Tensor, "P"]:
        """Return where beams end: the median range, or the expected range where the median is infinite."""
        return torch.where(self.median_range_m.isfinite(), self.median_range_m, self.range_m)

    @property
    def returned(self) -> Bool[Tensor, "P"]:
        """Return which beams are more likely to return than not."""
        return self.drop_logit <= 0
