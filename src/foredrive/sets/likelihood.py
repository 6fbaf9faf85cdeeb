"""Negative log-likelihood of a set of objects under the output of a detector, and its parts."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.sets.associations import AssociationSum, sum_associations
from foredrive.sets.boxes import LabelledBoxes
from foredrive.sets.processes import PoissonMultiBernoulli


@dataclass(frozen=True)
class SetNll:
    """-log f(Y) in nats and its parts, float64 with gradients.

    The parts are expectations over associations, given the true objects. f is a sum over associations, so the
    parts add up to more than the whole. The difference is the entropy of the associations; `ambiguity`
    subtracts it.
    """

    nll: Float[Tensor, ""]
    """Exact value or upper bound; +inf if no association is possible. The gradient is that of the summed
    terms."""
    lower: float
    """Lower bound: the true value lies between `lower` and `nll`."""
    localisation: Float[Tensor, ""]
    """Part of the boxes of detected objects."""
    classification: Float[Tensor, ""]
    """Part of existence and class of detected objects."""
    false: Float[Tensor, ""]
    """Part of detections without an object; inf if a certain detection has none."""
    missed: Float[Tensor, ""]
    """Part of objects assigned to the background, -log λ; inf if the background does not allow one."""
    expected_background: Float[Tensor, ""]
    """Expected number of background objects, ∫λ."""
    ambiguity: Float[Tensor, ""]
    """Minus the entropy of the associations, ≤ 0 up to rounding. NaN if `nll` is infinite."""
    associations: AssociationSum
    """Association probabilities, and the detections or objects that make the value infinite."""
    pair_log_box: Float[Tensor, "E"]
    """Log-density of the object's box under the detection, for each pair in `associations`."""
    pair_log_label: Float[Tensor, "E"]
    """Log-probability that the detection exists with the object's label, for each pair."""
    log_background: Float[Tensor, "N"]
    """Log λ at each object."""


def set_nll(
    predicted: PoissonMultiBernoulli,
    objects: LabelledBoxes,
    *,
    k: int = 25,
    max_states: int = 1 << 21,
    gate_nats: float = 1e-10,
) -> SetNll:
    """Compute the PMB-NLL of one frame (thesis eq. 3.12, Paper A). Without a background it is the MB-NLL.

    `k`, `max_states` and `gate_nats` are those of `sum_associations`.

    Raises:
        InputError: a value is not finite, or a label is unknown. The message names the first.
    """
    detected, background = predicted.detected, predicted.background
    log_absent = detected.log_absence.double()
    # Without a background, an object without a detection is impossible
    if background is None:
        log_background = torch.full_like(objects.label, -math.inf, dtype=torch.float64)
        expected = torch.zeros((), dtype=torch.float64, device=log_absent.device)
    else:
        log_background, expected = background.log_intensity(objects), background.expected_count
    # The sum needs no gradient: it enters through the probabilities of its pairs
    with torch.no_grad():
        log_pair = detected.boxes.log_prob(objects) + detected.log_label(objects)
    sums = sum_associations(
        *(log.detach().cpu().numpy() for log in (log_pair, log_absent, log_background)),
        k=k, max_states=max_states, gate_nats=gate_nats,
    )  # fmt: skip
    i, j = (torch.as_tensor(index, device=log_absent.device) for index in (sums.detection, sums.object))
    # Terms with gradients, for the pairs that matter
    log_box = detected.boxes.log_prob_of_pairs(i, objects, j)
    log_label = detected.log_label_of_pairs(i, objects, j)
    localisation, classification = (_expected(sums.probability, log) for log in (log_box, log_label))
    false, missed = _expected(sums.absent, log_absent), _expected(sums.background, log_background)
    # Energy: expected negative log-weight under the association probabilities
    energy = localisation + classification + false + missed + expected
    value = energy.new_tensor(-sums.log_lower) + expected.detach()
    # d(-log Σ w) = Σ P(association) d(-log w): the gradient of the energy at fixed probabilities.
    # The value of the sum with the gradient of the energy
    nll = energy + (value - energy).detach()
    false = false + (math.inf if len(sums.impossible_detections) else 0.0)
    missed = missed + (math.inf if len(sums.impossible_objects) else 0.0)
    # Difference between the value and its parts: minus the entropy of the associations
    ambiguity = nll - (localisation + classification + false + missed + expected)
    lower = float(expected.detach()) - sums.log_upper
    return SetNll(
        nll, lower, localisation, classification, false, missed, expected, ambiguity, sums,
        log_box, log_label, log_background,
    )  # fmt: skip


def _expected(probability: Float[np.ndarray, "..."], log: Float[Tensor, "..."]) -> Float[Tensor, ""]:
    """Return Σ -P log, over the possible entries."""
    weight = torch.as_tensor(probability, device=log.device)
    counts = (weight > 0) & log.isfinite()
    return -(weight[counts] * log[counts]).sum()
