"""Relocation of Gaussians as samples of a distribution.

Dead Gaussians move to live ones, and faint ones walk at random (Kheradmand et al., "3D Gaussian Splatting as
Markov Chain Monte Carlo", 2024).
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.geometry.quaternions import multiply_quaternions
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.walk_kernel import walk_rows
from foredrive.ops.precision import numba_supports
from foredrive.ops.threads import in_parallel

MIN_OPACITY = 0.005
"""Gaussians with a lower opacity are dead."""
MAX_COPIES = 51
MIN_ROWS = 4096
"""Minimum number of Gaussians per thread."""
_STEEPNESS = 100.0
_STAYS = 0.15
"""Opacity above which the walk is less than a millionth of its full size."""


def split_evenly(
    opacity: Float[Tensor, "N"], copies: Int[Tensor, "N"]
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """Return opacity and scale factor of Gaussians split into `copies`, including themselves (eq. 9).

    With o' = 1 - (1 - o)^(1/n) the centre keeps its opacity. The scale is divided by Σ_{i=1..n} Σ_{k=0..i-1}
    binom(i-1, k) (-1)^k o'^(k+1) / √(k+1) over o, which keeps the integral of the rendered splat.
    """
    copies = copies.clamp(1, MAX_COPIES)
    shared = 1 - (1 - opacity.double()) ** (1 / copies)
    weight = torch.zeros(MAX_COPIES + 1, MAX_COPIES, dtype=torch.float64)
    for i in range(1, MAX_COPIES + 1):
        for k in range(i):
            weight[i, k] = math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1)
    # Row n of the table holds the coefficients of o'^(k+1), k = 0, 1, …, for n copies
    total = weight.cumsum(0).to(opacity.device)  # sum over i, up to n
    powers = shared[:, None] ** torch.arange(1, MAX_COPIES + 1, device=opacity.device)
    integral = (total[copies] * powers).sum(-1)
    return shared.to(opacity), (opacity / integral).to(opacity)


def random_walk_m(gaussians: Gaussians, step_m: float, generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """Return random steps of the centres: normal noise in the shape of each faint Gaussian (eq. 8).

    Args:
        gaussians: the Gaussians.
        step_m: λ_noise times the learning rate of the centres.
        generator: on the CPU, so that a run is the same on any device.
    """
    opacity = gaussians.opacity_logit.sigmoid()
    walking = opacity < _STAYS
    place = walking.cumsum(0)
    noise = torch.randn(int(place[-1]) if len(place) else 0, 3, generator=generator).to(gaussians.mean_m)
    # The walk fades for opaque Gaussians: a steep sigmoid about the limit of dead ones
    size = step_m * torch.sigmoid(-_STEEPNESS * (opacity - MIN_OPACITY)) * walking
    parts = (size, gaussians.log_scale, gaussians.quaternion, noise)
    if not numba_supports(*parts):
        way = torch.zeros_like(gaussians.mean_m)
        way[walking] = size[walking, None] * shaped(
            gaussians.log_scale[walking], gaussians.quaternion[walking], noise
        )
        return way
    way = torch.empty_like(gaussians.mean_m)
    rows = [
        value.detach().contiguous().numpy()
        for value in (size, (2 * gaussians.log_scale).exp(), gaussians.quaternion, noise, place - 1, way)
    ]
    in_parallel(lambda start, stop: walk_rows(*rows, start, stop), len(way), MIN_ROWS)
    return way


def shaped(
    log_scale: Float[Tensor, "N 3"], quaternion: Float[Tensor, "N 4"], noise: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Return Σ · noise with Σ = R S² Rᵀ: turned to the Gaussian's axes, scaled, turned back."""
    return _turned(quaternion, log_scale.exp() ** 2 * _turned(quaternion, noise, inverse=True))


def _turned(
    quaternion: Float[Tensor, "N 4"], vector: Float[Tensor, "N 3"], inverse: bool = False
) -> Float[Tensor, "N 3"]:
    unit = torch.nn.functional.normalize(quaternion, dim=-1)
    back = unit * unit.new_tensor([1.0, -1.0, -1.0, -1.0])
    first, last = (back, unit) if inverse else (unit, back)
    return multiply_quaternions(multiply_quaternions(first, torch.nn.functional.pad(vector, (1, 0))), last)[
        :, 1:
    ]
