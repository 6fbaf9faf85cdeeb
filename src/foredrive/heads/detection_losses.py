"""Losses of a detection head: matching with a likelihood or an energy score, or the likelihood of the set."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.heads.detection_network import BoxSet
from foredrive.sets import Family, LabelledBoxes, PoissonMultiBernoulli, set_nll
from foredrive.sets.assignment import best_assignment

STATE_SCALE = (1.0, 1.0, 1.0, 0.3, 0.3, 0.3)
"""Errors of this size, in m and log m, have equal weight."""

NO_OBJECT_WEIGHT = 0.1
"""Weight of queries without an object in the loss of classes: most queries have none."""
TAUGHT_M = 4.0
"""A matched box whose centre is farther from its object than this learns only to come nearer: its velocity,
attribute, motion and mask would be read from a place where the object is not."""

Loss = Callable[[BoxSet, LabelledBoxes], Float[Tensor, ""]]
"""The loss of one frame: `matching_loss` or `set_loss`."""


@dataclass(frozen=True)
class MatchingLossConfig:
    """Options and weights of `matching_loss`."""

    box_score: Literal["likelihood", "energy"] = "likelihood"
    """Score that trains the state of matched boxes."""
    box_weight: float = 0.5
    heading_weight: float = 0.5
    likelihood_weight: float = 0.1
    energy_samples: int = 1000


def set_loss(predicted: BoxSet, truth: LabelledBoxes) -> Float[Tensor, ""]:
    """Return the MB-NLL of one frame per object (Paper A). All associations count by their likelihood.

    It is +inf if there are more objects than queries, because there is no background.
    """
    pmb = PoissonMultiBernoulli(predicted.as_multi_bernoulli())
    return set_nll(pmb, truth).nll / max(len(truth.label), 1)


def matching_loss(
    predicted: BoxSet, truth: LabelledBoxes, config: MatchingLossConfig = MatchingLossConfig()
) -> Float[Tensor, ""]:
    """Return the DETR loss of one frame per object: cross-entropy and box error of the best matching.

    With `box_score` "likelihood", L1 trains the means. The likelihood of matched boxes with fixed means
    trains the standard deviations. With "energy", the energy score trains both, but not the heading.
    """
    query, match = best_matching(predicted, truth, config)
    return matched_loss(predicted, truth, query, match, config)


def matched_loss(
    predicted: BoxSet,
    truth: LabelledBoxes,
    query: Int[Tensor, "n"],
    match: Int[Tensor, "n"],
    config: MatchingLossConfig = MatchingLossConfig(),
) -> Float[Tensor, ""]:
    """Return `matching_loss` for a given matching of queries and objects."""
    assert truth.yaw is not None
    objects = max(len(truth.label), 1)
    classes = predicted.logits.shape[-1] - 1
    # Queries without an object have the last class, "no object"
    target = torch.full(predicted.logits.shape[:1], classes, device=predicted.logits.device)
    target[query] = truth.label[match].long()
    weight = torch.where(target == classes, NO_OBJECT_WEIGHT, 1.0)
    entropy = (F.cross_entropy(predicted.logits, target, reduction="none") * weight).sum()
    state, scale = truth.state[match].to(predicted.mean), predicted.mean.new_tensor(STATE_SCALE)
    mean, log_std, log_std_yaw = predicted.mean[query], predicted.log_std[query], predicted.log_std_yaw[query]
    yaw = truth.yaw[match].to(predicted.mean)
    arrow = torch.stack([yaw.sin(), yaw.cos()], dim=-1)
    # Heading by L1 of sine and cosine
    turn = (predicted.heading[query] - arrow).abs().sum()
    cos = (predicted.heading[query].detach() * arrow).sum(-1)
    # Negative log-likelihood of the heading near a von Mises density: log σ + (1 - cos) / σ²
    spread = (log_std_yaw + (1 - cos) * (-2 * log_std_yaw).exp()).sum()
    if config.box_score == "energy":
        score = energy_score(
            mean / scale, log_std.exp() / scale, state / scale, predicted.family, config.energy_samples
        )
        box = score.sum()
    else:
        # Fixed means: the likelihood trains the standard deviations alone
        box = ((mean - state).abs() / scale).sum()
        spread = _negative_log_likelihood(mean.detach(), log_std, state, predicted.family).sum() + spread
    return (
        entropy + config.box_weight * box + config.heading_weight * turn + config.likelihood_weight * spread
    ) / objects


def _negative_log_likelihood(
    mean: Float[Tensor, "n D"], log_std: Float[Tensor, "n D"], state: Float[Tensor, "n D"], family: Family
) -> Float[Tensor, "n D"]:
    """Return the negative log-likelihood of each coordinate, without its constant."""
    z = (mean - state) / log_std.exp()
    # Standard deviation σ: Gaussian exponent z²/2, Laplace exponent √2 |z|
    return (0.5 * z.square() if family == "gaussian" else math.sqrt(2) * z.abs()) + log_std


def energy_score(
    mean: Float[Tensor, "n D"],
    std: Float[Tensor, "n D"],
    state: Float[Tensor, "n D"],
    family: Family,
    samples: int,
) -> Float[Tensor, "n"]:
    """Estimate the energy score of each box, with gradients of mean and standard deviation.

    It is E|X - y| - ½ E|X - X'| with Euclidean norms. The estimate from `samples` + 1 draws is unbiased. X'
    is the draw that follows X, as in Harakeh and Waslander (2021, arXiv 2101.05036).
    """
    zero, one = mean.new_tensor(0.0), mean.new_tensor(1.0)
    unit = (
        torch.distributions.Normal(zero, one)
        if family == "gaussian"
        else torch.distributions.Laplace(zero, one / math.sqrt(2))
    )
    draws = mean + std * unit.sample(torch.Size((samples + 1, *mean.shape)))
    # E|X - y| over the draws, and E|X - X'| over successive draws
    to_truth = (draws[:-1] - state).norm(dim=-1).mean(0)
    between = (draws[1:] - draws[:-1]).norm(dim=-1).mean(0)
    return to_truth - 0.5 * between


def best_matching(
    predicted: BoxSet, truth: LabelledBoxes, config: MatchingLossConfig = MatchingLossConfig()
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Return matched queries and objects. Each object has one query, if there are enough."""
    with torch.no_grad():
        class_cost = -predicted.logits.softmax(-1)[:, truth.label.long()]
        scale = predicted.mean.new_tensor(STATE_SCALE)
        error = (predicted.mean[:, None] - truth.state.to(predicted.mean)) / scale
        # Rows are objects, columns are queries
        cost = (class_cost + config.box_weight * error.abs().sum(-1)).T.double().cpu().numpy()
    unmatched = np.full(len(cost), 1.0 + 2.0 * np.abs(cost).sum())  # dearer than all pairs
    column = torch.as_tensor(best_assignment(cost, unmatched).column)
    match = (column >= 0).nonzero()[:, 0]
    return column[match].to(predicted.mean.device), match.to(predicted.mean.device)


def near_pairs(
    predicted: BoxSet, truth: LabelledBoxes, query: Int[Tensor, "n"], match: Int[Tensor, "n"]
) -> tuple[Int[Tensor, "_n"], Int[Tensor, "_n"]]:
    """Return the matched pairs that are at most `TAUGHT_M` apart over ground."""
    apart_m = (predicted.mean[query, :2].detach() - truth.state[match, :2].to(predicted.mean)).norm(dim=-1)
    near = apart_m <= TAUGHT_M
    return query[near], match[near]
