"""Conversion of 3-D detections and boxes into random finite sets."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene.boxes import Boxes
from foredrive.scene.detections import Detections
from foredrive.sets.boxes import BoxDensity, LabelledBoxes, require
from foredrive.sets.processes import MultiBernoulli, PoissonMultiBernoulli, UniformPoisson

_TINY = 1e-12


def pmb_from_detections(
    detections: Detections,
    lower: Float[Tensor, "6"] | None = None,
    upper: Float[Tensor, "6"] | None = None,
) -> PoissonMultiBernoulli:
    """Convert the detections of one frame into a PMB density.

    The background is uniform over states between `lower` and `upper`. A state is the centre (ego frame, m)
    and log lwh (m). The covariance between state and heading is dropped. The heading has a von Mises
    distribution with κ = 1/σ², where σ² is the first-order variance of the angle.

    Raises:
        InputError: a probability is outside [0, 1], a covariance is not positive definite, or a background
            has no region.
    """
    kept = dataclasses.replace(detections, background_rate=None)[detections.valid]
    existence = kept.existence.double()
    require("existence of detection", (existence >= 0) & (existence <= 1))
    sin, cos = kept.mean[:, 6].double(), kept.mean[:, 7].double()
    # dθ = (cos · d sin - sin · d cos) / ρ², for any length ρ of the vector (sin, cos).
    square = (sin.square() + cos.square()).clamp_min(_TINY)
    across = torch.stack([cos, -sin], dim=-1) / square[:, None]
    variance = (across[:, None] @ kept.chol[:, 6:].double()).square().sum((-2, -1))
    boxes = BoxDensity(
        mean=kept.mean[:, :6],
        chol=kept.chol[:, :6, :6],  # the marginal: the factor is lower triangular
        yaw=torch.atan2(sin, cos),
        concentration=1.0 / variance.clamp_min(_TINY),
    )
    detected = MultiBernoulli(existence.log(), torch.log1p(-existence), kept.log_class, boxes)
    if detections.background_rate is None:
        return PoissonMultiBernoulli(detected)
    if lower is None or upper is None:
        raise InputError("detections with a background need the region it is spread over")
    return PoissonMultiBernoulli(detected, UniformPoisson(detections.background_rate, lower, upper, True))


def objects_from_boxes(boxes: Boxes) -> LabelledBoxes:
    """Return the valid boxes of one time step as objects.

    Raises:
        InputError: a size is not positive. The message names the first such box.
    """
    require("size of box", (boxes.size_lwh > 0).all(-1) | ~boxes.valid)
    kept = boxes[boxes.valid]
    state = torch.cat([kept.centre.double(), kept.size_lwh.double().log()], dim=-1)
    return LabelledBoxes(kept.category, state, kept.yaw.double())
