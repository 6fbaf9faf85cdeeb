"""Output of a 3-D detector, with the uncertainty that set likelihoods need."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class Detections(Record):
    """M detections in the ego frame at now, padded.

    The state is centre (3, m), log lwh (3), sin yaw, cos yaw.
    """

    existence: Float[Tensor, "*b M"]
    """Probability that the object exists."""
    log_class: Float[Tensor, "*b M K"]
    """Log-probability of each class, given that the object exists."""
    mean: Float[Tensor, "*b M 8"]
    chol: Float[Tensor, "*b M 8 8"]
    """Lower Cholesky factor of the covariance of the state."""
    valid: Bool[Tensor, "*b M"]
    background_rate: Float[Tensor, "*b K"] | None = None
    """Expected number of undetected objects per class (the Poisson part of a PMB). None if not modelled."""
