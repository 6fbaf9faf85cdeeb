"""What a scene is made of."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class Gaussians(Record):
    """N Gaussians in the frame of a scene (or of an actor), as optimisers know them (Kerbl et al., 2023)."""

    mean_m: Float[Tensor, "N 3"]
    quaternion: Float[Tensor, "N 4"]
    """w x y z of the rotation from the Gaussian's axes to the frame; of any length but 0."""
    log_scale: Float[Tensor, "N 3"]
    """Logarithm of the standard deviations along the Gaussian's axes, m."""
    opacity_logit: Float[Tensor, "N"]
    feature: Float[Tensor, "N D"]
    """Albedo r g b first, then whatever decoders make use of."""

    def factor(self) -> Float[Tensor, "3 3 N"]:
        """M = R S, with which the covariance is M Mᵀ, m.

        Components come first because arithmetic on long vectors is many times as fast as on small matrices.
        """
        w, x, y, z = self.quaternion.T.contiguous()
        a, b, c = self.log_scale.exp().T.contiguous()
        twice = 2 / (w * w + x * x + y * y + z * z)
        wx, wy, wz = twice * w * x, twice * w * y, twice * w * z
        xx, xy, xz, yy, yz, zz = (twice * i * j for i, j in ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z)))
        entries = [
            *((1 - yy - zz) * a, (xy - wz) * b, (xz + wy) * c),
            *((xy + wz) * a, (1 - xx - zz) * b, (yz - wx) * c),
            *((xz - wy) * a, (yz + wx) * b, (1 - xx - yy) * c),
        ]
        return torch.stack(entries).unflatten(0, (3, 3))
