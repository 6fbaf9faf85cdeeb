"""Labelled boxes, and densities over boxes: position and size on a line each, heading on the circle.

A box's `state` is what a density is taken over: in images the pixel coordinates of two corners, or centre and
size (the density is the same: the change of variables has determinant 1); in 3-D the centre in m and the
logarithm of length, width and height in m, beside which the heading in rad stands alone.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene.record import Record

_LOG_2PI = math.log(2 * math.pi)


@dataclass(frozen=True)
class LabelledBoxes(Record):
    """Objects of one frame. All of them have a heading, or none has."""

    label: Int[Tensor, "*b N"]
    state: Float[Tensor, "*b N D"]
    yaw: Float[Tensor, "*b N"] | None = None


@dataclass(frozen=True)
class BoxDensity(Record):
    """M densities over boxes, each with the heading independent of the rest; computed in float64.

    With L = `chol`, L⁻¹(state - mean) has independent coordinates of mean 0 and variance 1: normal, or
    Laplace (of scale 1/√2). So L Lᵀ is the covariance either way. The heading is von Mises distributed.

    Raises `InputError` where a covariance is not positive definite or a value not finite, naming the first.
    """

    mean: Float[Tensor, "*b M D"]
    chol: Float[Tensor, "*b M D D"]
    """Lower Cholesky factor of the covariance."""
    yaw: Float[Tensor, "*b M"] | None = None
    concentration: Float[Tensor, "*b M"] | None = None
    """κ of the heading; 0 is uniform, about 1/σ² where it is large."""
    family: Literal["gaussian", "laplace"] = "gaussian"

    def __post_init__(self) -> None:
        if (self.yaw is None) != (self.concentration is None):
            raise InputError("a box density has a heading and its concentration, or neither")
        diagonal = self.chol.diagonal(dim1=-2, dim2=-1)
        require("covariance (of which only positive definite ones are densities)", (diagonal > 0).all(-1))
        require("covariance", self.chol.isfinite().all(-1).all(-1))
        require("mean", self.mean.isfinite().all(-1))
        if self.yaw is not None and self.concentration is not None:
            require("heading", self.yaw.isfinite())
            require("concentration", self.concentration.isfinite() & (self.concentration >= 0))

    def log_prob(self, boxes: LabelledBoxes) -> Float[Tensor, "*b M N"]:
        """Log-density of each box under each component, float64. Raises `InputError` for boxes not finite."""
        require("state of object", boxes.state.isfinite().all(-1))
        chol = self.chol.double()
        offset = boxes.state.double()[..., None, :, :] - self.mean.double()[..., :, None, :]
        white = torch.linalg.solve_triangular(chol, offset.mT, upper=False)  # [*b M D N]
        if self.family == "gaussian":
            log_prob = -0.5 * (white.square() + _LOG_2PI).sum(-2)
        else:
            log_prob = -(math.sqrt(2) * white.abs() + 0.5 * math.log(2)).sum(-2)
        log_prob = log_prob - chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)[..., None]
        if self.yaw is None or self.concentration is None:
            return log_prob
        if boxes.yaw is None:
            raise InputError("densities with a heading are asked about boxes without one")
        require("heading of object", boxes.yaw.isfinite())
        kappa = self.concentration.double()[..., None]
        cos = (boxes.yaw.double()[..., None, :] - self.yaw.double()[..., :, None]).cos()
        # i0e(κ) = I₀(κ)·exp(-κ): without it large concentrations overflow.
        return log_prob + kappa * (cos - 1) - torch.special.i0e(kappa).log() - _LOG_2PI

    def sample(
        self, rng: np.random.Generator
    ) -> tuple[Float[Tensor, "*b M D"], Float[Tensor, "*b M"] | None]:
        """One state and heading from each component, float64."""
        shape = self.mean.shape
        scale = math.sqrt(0.5)
        white = rng.normal(size=shape) if self.family == "gaussian" else rng.laplace(0.0, scale, shape)
        shift = self.chol.double().cpu() @ torch.as_tensor(white)[..., None]
        state = self.mean.double().cpu() + shift[..., 0]
        if self.yaw is None or self.concentration is None:
            return state, None
        yaw = rng.vonmises(self.yaw.double().cpu().numpy(), self.concentration.double().cpu().numpy())
        return state, torch.as_tensor(yaw)


def require(what: str, valid: Bool[Tensor, "..."]) -> None:
    """Raise `InputError` that names the first entry that is not valid."""
    if not bool(valid.all()):
        raise InputError(f"{what} {tuple((~valid).nonzero()[0].tolist())} is not valid")
