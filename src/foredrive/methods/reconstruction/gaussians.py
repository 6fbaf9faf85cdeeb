"""The 3-D Gaussians of a scene."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class Gaussians(Record):
    """N Gaussians in the frame of a scene or an actor, as unconstrained parameters (Kerbl et al., 2023)."""

    mean_m: Float[Tensor, "N 3"]
    quaternion: Float[Tensor, "N 4"]
    """w x y z of the rotation from the axes of the Gaussian to the frame; any length except 0."""
    log_scale: Float[Tensor, "N 3"]
    """Logarithm of the standard deviations (m) along the axes of the Gaussian."""
    opacity_logit: Float[Tensor, "N"]
    feature: Float[Tensor, "N D"]
    """Albedo r g b first, then features for the decoders."""

    def factor(self) -> Float[Tensor, "3 3 N"]:
        """Return M = R S, m; the covariance is M Mᵀ.

        Components come first because arithmetic on long vectors is many times faster than on small matrices.
        """
        q = self.quaternion.T.contiguous()
        w, x, y, z = q * (0.5 * (q * q).sum(0)).rsqrt()  # length √2: products are twice those of length 1
        xx, yy, zz = x * x, y * y, z * z
        xy, xz, yz = x * y, x * z, y * z
        wx, wy, wz = w * x, w * y, w * z
        rotation = [
            *(1 - yy - zz, xy - wz, xz + wy),
            *(xy + wz, 1 - xx - zz, yz - wx),
            *(xz - wy, yz + wx, 1 - xx - yy),
        ]
        return torch.stack(rotation).unflatten(0, (3, 3)) * self.log_scale.exp().T.contiguous()


def joined(parts: list[Gaussians]) -> Gaussians:
    """Concatenate sets of Gaussians."""
    names = [field.name for field in dataclasses.fields(Gaussians)]
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in names))
