"""Negative log-likelihood of a set of objects under what a detector says, and what it is made of."""

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
    """-log f(Y) in nats, as the sum of its parts; all float64, and with gradients.

    Parts are expectations over associations, given the truth. Since f sums over associations, they add up to
    more than the whole by the entropy of the associations, which `ambiguity` takes off.
    """

    nll: Float[Tensor, ""]
    """Exact, or an upper bound; +inf if no association is possible. Its gradient is that of what it sums."""
    lower: float
    """The true value lies between here and `nll`."""
    localisation: Float[Tensor, ""]
    """Boxes of objects that are detected."""
    classification: Float[Tensor, ""]
    """Existence and class of objects that are detected."""
    false: Float[Tensor, ""]
    """Detections without an object; inf if a certain one has none."""
    missed: Float[Tensor, ""]
    """Objects left to the background, -log λ; inf where it allows none."""
    expected_background: Float[Tensor, ""]
    """∫λ."""
    ambiguity: Float[Tensor, ""]
    """Minus the entropy of the associations, never positive but for rounding; NaN if `nll` is infinite."""
    associations: AssociationSum
    """Who belongs to whom, and which detections or objects make the value infinite."""
    pair_log_box: Float[Tensor, "E"]
    """Log-density of the object's box, of each pair in `associations`."""
    pair_log_label: Float[Tensor, "E"]
    """Log-probability that the detection exists with the object's label."""
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
    """PMB-NLL of one frame (thesis eq. 3.12, Paper A); MB-NLL if there is no background.

    `k`, `max_states` and `gate_nats` as in `sum_associations`. Raises `InputError` for values that are not
    finite, or labels that are unknown, naming the first.
    """
    detected, background = predicted.detected, predicted.background
    log_absent = detected.log_absence.double()
    if background is None:
        log_background = torch.full_like(objects.label, -math.inf, dtype=torch.float64)
        expected = torch.zeros((), dtype=torch.float64, device=log_absent.device)
    else:
        log_background, expected = background.log_intensity(objects), background.expected_count
    with torch.no_grad():
        log_pair = detected.boxes.log_prob(objects) + detected.log_label(objects)
    found = sum_associations(
        *(log.detach().cpu().numpy() for log in (log_pair, log_absent, log_background)),
        k=k, max_states=max_states, gate_nats=gate_nats,
    )  # fmt: skip
    i, j = (torch.as_tensor(index, device=log_absent.device) for index in (found.detection, found.object))
    log_box = detected.boxes.log_prob_of_pairs(i, objects, j)
    log_label = detected.log_label_of_pairs(i, objects, j)
    localisation, classification = (_expected(found.probability, log) for log in (log_box, log_label))
    false, missed = _expected(found.absent, log_absent), _expected(found.background, log_background)
    energy = localisation + classification + false + missed + expected
    value = energy.new_tensor(-found.log_lower) + expected.detach()
    # d(-log Σ w) = Σ P(association) d(-log w): the gradient of the energy at fixed probabilities.
    nll = energy + (value - energy).detach()
    false = false + (math.inf if len(found.impossible_detections) else 0.0)
    missed = missed + (math.inf if len(found.impossible_objects) else 0.0)
    ambiguity = nll - (localisation + classification + false + missed + expected)
    lower = float(expected.detach()) - found.log_upper
    return SetNll(
        nll, lower, localisation, classification, false, missed, expected, ambiguity, found,
        log_box, log_label, log_background,
    )  # fmt: skip


def _expected(probability: Float[np.ndarray, "..."], log: Float[Tensor, "..."]) -> Float[Tensor, ""]:
    """Σ -P log, over what is possible."""
    weight = torch.as_tensor(probability, device=log.device)
    counts = (weight > 0) & log.isfinite()
    return -(weight[counts] * log[counts]).sum()
