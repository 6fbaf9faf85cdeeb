"""Labelled boxes and densities over boxes. Position and size are real-valued; heading is an angle.

The density is taken over the `state` of a box. In images it is the pixel coordinates of two corners, or
centre and size; both give the same density, because the change of variables has determinant 1. In 3-D it is
the centre in m and the logarithm of length, width and height in m. The heading in rad is separate.
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
from foredrive.sets.box_kernel import add_heading, box_log_prob

Family = Literal["gaussian", "laplace"]

_LOG_2PI = math.log(2 * math.pi)


@dataclass(frozen=True)
class LabelledBoxes(Record):
    """The objects of one frame. Either all have a heading, or none has."""

    label: Int[Tensor, "*b N"]
    state: Float[Tensor, "*b N D"]
    yaw: Float[Tensor, "*b N"] | None = None


@dataclass(frozen=True)
class BoxDensity(Record):
    """M densities over boxes, computed in float64. In each, the heading is independent of the state.

    With L = `chol`, L⁻¹(state - mean) has independent coordinates of mean 0 and variance 1. They are normal,
    or Laplace with scale 1/√2. So L Lᵀ is the covariance in both cases. The heading has a von Mises
    distribution.

    Raises:
        InputError: a covariance is not positive definite, or a value is not finite. The message names the
            first.
    """

    mean: Float[Tensor, "*b M D"]
    chol: Float[Tensor, "*b M D D"]
    """Lower Cholesky factor of the covariance."""
    yaw: Float[Tensor, "*b M"] | None = None
    concentration: Float[Tensor, "*b M"] | None = None
    """Concentration κ of the heading. 0 is uniform; a large κ is about 1/σ²."""
    family: Family = "gaussian"

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
        """Return the log-density of each box under each component, float64.

        Raises:
            InputError: a box is not finite, or it has no heading although the density has one.
        """
        self._require_boxes(boxes)
        if self.mean.dim() == 2 and self.mean.device.type == "cpu" and not needs_gradient(self, boxes):
            return torch.as_tensor(self._values(boxes))
        # Whitened offsets L⁻¹ (state - mean)
        chol = self.chol.double()
        offset = boxes.state.double()[..., None, :, :] - self.mean.double()[..., :, None, :]
        white = torch.linalg.solve_triangular(chol, offset.mT, upper=False).mT  # [*b M N D]
        log_scale = chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)[..., None]
        log_prob = self._log_white(white) - log_scale
        # log |L|, half the log-determinant of the covariance
        if self.yaw is None or self.concentration is None or boxes.yaw is None:
            return log_prob
        turn = boxes.yaw.double()[..., None, :] - self.yaw.double()[..., :, None]
        return log_prob + _log_von_mises(turn, self.concentration.double()[..., None])

    def log_prob_of_pairs(
        self, component: Int[Tensor, "E"], boxes: LabelledBoxes, box: Int[Tensor, "E"]
    ) -> Float[Tensor, "E"]:
        """Return `log_prob` at pairs of a component and a box of one frame."""
        chol = self.chol[component].double()
        offset = boxes.state[box].double() - self.mean[component].double()
        white = torch.linalg.solve_triangular(chol, offset[..., None], upper=False)[..., 0]
        log_prob = self._log_white(white) - chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        if self.yaw is None or self.concentration is None or boxes.yaw is None:
            return log_prob
        turn = boxes.yaw[box].double() - self.yaw[component].double()
        return log_prob + _log_von_mises(turn, self.concentration[component].double())

    def _log_white(self, white: Float[Tensor, "*e D"]) -> Float[Tensor, "*e"]:
        if self.family == "gaussian":
            return -0.5 * (white.square() + _LOG_2PI).sum(-1)
        return -(math.sqrt(2) * white.abs() + 0.5 * math.log(2)).sum(-1)

    def _values(self, boxes: LabelledBoxes) -> Float[np.ndarray, "M N"]:
        """Return `log_prob` without gradients."""
        mean, chol, state = (_numbers(values) for values in (self.mean, self.chol, boxes.state))
        log_prob = box_log_prob(mean, chol, state, self.family == "laplace")
        if self.yaw is not None and self.concentration is not None and boxes.yaw is not None:
            log_i0e = torch.special.i0e(self.concentration.double()).log()
            heading = (self.yaw, self.concentration, log_i0e, boxes.yaw)
            add_heading(log_prob, *(_numbers(values) for values in heading))
        return log_prob

    def _require_boxes(self, boxes: LabelledBoxes) -> None:
        require("state of object", boxes.state.isfinite().all(-1))
        if self.yaw is None:
            return
        if boxes.yaw is None:
            raise InputError("densities with a heading are asked about boxes without one")
        require("heading of object", boxes.yaw.isfinite())

    def sample(
        self, rng: np.random.Generator
    ) -> tuple[Float[Tensor, "*b M D"], Float[Tensor, "*b M"] | None]:
        """Draw one state and one heading from each component, float64."""
        shape = self.mean.shape
        scale = math.sqrt(0.5)
        # A Laplace variable of variance 1 has scale 1/√2
        white = rng.normal(size=shape) if self.family == "gaussian" else rng.laplace(0.0, scale, shape)
        shift = self.chol.double().cpu() @ torch.as_tensor(white)[..., None]
        state = self.mean.double().cpu() + shift[..., 0]
        if self.yaw is None or self.concentration is None:
            return state, None
        yaw = rng.vonmises(self.yaw.double().cpu().numpy(), self.concentration.double().cpu().numpy())
        return state, torch.as_tensor(yaw)


def needs_gradient(*records: Record) -> bool:
    """Return whether any tensor of the records needs a gradient."""
    return torch.is_grad_enabled() and any(
        value.requires_grad
        for record in records
        for value in vars(record).values()
        if isinstance(value, Tensor)
    )


def _numbers(values: Tensor) -> Float[np.ndarray, "..."]:
    return np.ascontiguousarray(values.detach().cpu().double().numpy())


def _log_von_mises(turn: Float[Tensor, "*e"], kappa: Float[Tensor, "..."]) -> Float[Tensor, "*e"]:
    # i0e(κ) = I₀(κ)·exp(-κ). I₀ itself overflows for large concentrations.
    return kappa * (turn.cos() - 1) - torch.special.i0e(kappa).log() - _LOG_2PI


def require(what: str, valid: Bool[Tensor, "..."]) -> None:
    """Raise `InputError` with the index of the first invalid entry."""
    if not bool(valid.all()):
        raise InputError(f"{what} {tuple((~valid).nonzero()[0].tolist())} is not valid")
