"""Predicted and true agents with their futures, as every motion protocol reads them."""

import dataclasses
from dataclasses import dataclass
from typing import Any, TypeVar, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

Agents = TypeVar("Agents", "PredictedAgents", "TrueAgents")


@dataclass(frozen=True)
class PredictedAgents:
    """M detected agents of all frames of a data set, each with K alternative futures of T steps of 0.5 s."""

    frame: Int[ndarray, "M"]
    """Number of the frame."""
    category: Int[ndarray, "M"]
    """A `scene.Category`, or an index into the data set's own list of classes."""
    score: Float[ndarray, "M"]
    """Detection score in [0, 1]."""
    xy: Float[ndarray, "M 2"]
    """Box centre, in the ego frame at the frame's time, m."""
    future_xy: Float[ndarray, "M K T 2"]
    """Box centres at the steps after now, in the same frame, m."""
    probability: Float[ndarray, "M K"]
    """Probability of each alternative, or any score that ranks them."""

    def __getitem__(self, which: Any) -> "PredictedAgents":
        """Index the agents."""
        return _indexed(self, which)


@dataclass(frozen=True)
class TrueAgents:
    """N annotated agents of all frames of a data set, each with the future that it drove."""

    frame: Int[ndarray, "N"]
    category: Int[ndarray, "N"]
    xy: Float[ndarray, "N 2"]
    """Box centre, in the ego frame at the frame's time, m."""
    future_xy: Float[ndarray, "N T 2"]
    """Box centres at the steps after now, in the same frame, m."""
    future_valid: Bool[ndarray, "N T"]
    """True where the agent is annotated. Public code stops at the first gap, and so do the protocols here."""
    seen: Bool[ndarray, "N"]
    """True unless the box is known to hold no point of a sensor."""

    def __getitem__(self, which: Any) -> "TrueAgents":
        """Index the agents."""
        return _indexed(self, which)

    def steps_known(self, horizon: int) -> Int[ndarray, "N"]:
        """Return the number of steps before the first gap, at most `horizon`."""
        # The product is 0 from the first gap on
        return np.cumprod(self.future_valid[:, :horizon], axis=1).sum(axis=1)


def _indexed(agents: Agents, which: Any) -> Agents:
    fields = {field.name: getattr(agents, field.name)[which] for field in dataclasses.fields(agents)}
    return dataclasses.replace(agents, **fields)


@dataclass(frozen=True)
class DisplacementErrors:
    """Distances in m between the K futures of P predictions and the futures of their agents."""

    mean: Float[ndarray, "P K"]
    """Over the known steps (ADE)."""
    last: Float[ndarray, "P K"]
    """At the last known step (FDE)."""
    worst: Float[ndarray, "P K"]
    """At the step where it is largest."""

    def __getitem__(self, which: Any) -> "DisplacementErrors":
        """Index the predictions."""
        return DisplacementErrors(self.mean[which], self.last[which], self.worst[which])


def displacement_errors(
    future_xy: Float[ndarray, "P K T 2"], true_xy: Float[ndarray, "P S 2"], steps: Int[ndarray, "P"]
) -> DisplacementErrors:
    """Return the errors over the first `steps` (at most T and S) of each pair; 0 for a pair without any."""
    errors = _errors(future_xy, true_xy, steps)
    return DisplacementErrors(errors[0], errors[1], errors[2])


@numba.njit(cache=True, nogil=True)
@no_type_check
def _errors(future_xy, true_xy, steps):
    pairs, modes = future_xy.shape[:2]
    errors = np.zeros((3, pairs, modes))
    for i in range(pairs):
        for k in range(modes):
            # Only the known steps count
            for t in range(steps[i]):
                x = future_xy[i, k, t, 0] - true_xy[i, t, 0]
                y = future_xy[i, k, t, 1] - true_xy[i, t, 1]
                distance_m = np.sqrt(x * x + y * y)
                # Mean, last and largest distance, step by step
                errors[0, i, k] += distance_m / steps[i]
                errors[1, i, k] = distance_m
                errors[2, i, k] = max(errors[2, i, k], distance_m)
    return errors
