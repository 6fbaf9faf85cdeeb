"""What a scene is made of."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
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
        w, x, y, z = F.normalize(self.quaternion, dim=-1).unbind(-1)
        a, b, c = self.log_scale.exp().unbind(-1)
        rows = (
            ((1 - 2 * (y * y + z * z)) * a, 2 * (x * y - w * z) * b, 2 * (x * z + w * y) * c),
            (2 * (x * y + w * z) * a, (1 - 2 * (x * x + z * z)) * b, 2 * (y * z - w * x) * c),
            (2 * (x * z - w * y) * a, 2 * (y * z + w * x) * b, (1 - 2 * (x * x + y * y)) * c),
        )
        return torch.stack([entry for row in rows for entry in row]).unflatten(0, (3, 3))
