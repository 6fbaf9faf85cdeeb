"""Diagonal Gaussians: the stochastic states of a state-space model."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class DiagonalGaussian(Record):
    """The distribution N(mean, diag(std²))."""

    mean: Float[Tensor, "*b S"]
    std: Float[Tensor, "*b S"]

    @classmethod
    def from_output(cls, raw: Float[Tensor, "*b _R"], min_std: float) -> "DiagonalGaussian":
        """Build it from a network's output: mean, and std = 2 sigmoid(raw / 2) + `min_std` (as in MILE)."""
        mean, raw_std = raw.float().chunk(2, dim=-1)
        return cls(mean, 2 * torch.sigmoid(raw_std / 2) + min_std)

    @classmethod
    def standard(cls, like: Float[Tensor, "*b S"]) -> "DiagonalGaussian":
        """Return N(0, I) in the shape of another state."""
        return cls(torch.zeros_like(like), torch.ones_like(like))

    def sample(self, generator: torch.Generator | None = None) -> Float[Tensor, "*b S"]:
        """Draw a reparametrised sample, so that gradients reach mean and std (Kingma & Welling 2014)."""
        # The generator decides the device of the noise, so that a CPU seed draws the same on a GPU
        device = self.mean.device if generator is None else generator.device
        noise = torch.randn(self.mean.shape, generator=generator, device=device, dtype=self.mean.dtype)
        return self.mean + self.std * noise.to(self.mean.device)

    def detach(self) -> "DiagonalGaussian":
        """Return a copy without gradient."""
        return self.map_tensors(torch.detach)


def kl_divergence(q: DiagonalGaussian, p: DiagonalGaussian) -> Float[Tensor, "*b"]:
    """Return KL(q ‖ p) = Σ ln(σp/σq) + (σq² + (μq - μp)²) / 2σp² - 1/2, in nats."""
    terms = (p.std / q.std).log() + (q.std**2 + (q.mean - p.mean) ** 2) / (2 * p.std**2) - 0.5
    return terms.sum(dim=-1)


def balanced_kl(posterior: DiagonalGaussian, prior: DiagonalGaussian, balance: float) -> Float[Tensor, "*b"]:
    """Return balance · KL(sg(q) ‖ p) + (1 - balance) · KL(q ‖ sg(p)) (KL balancing, Hafner et al. 2021).

    The value equals KL(q ‖ p). With balance > 1/2 the prior moves faster towards the posterior than the
    posterior towards the prior.
    """
    # The detached distribution is the target of the other one
    of_prior = kl_divergence(posterior.detach(), prior)
    of_posterior = kl_divergence(posterior, prior.detach())
    return balance * of_prior + (1 - balance) * of_posterior
