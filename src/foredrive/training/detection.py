"""Two ways to train a detection head: matching (DETR) or the likelihood of the set (Paper A)."""

import copy
from collections.abc import Callable, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from foredrive.errors import InputError
from foredrive.models.detection import BoxSet, DetectionHead
from foredrive.sets import BoxDensity, LabelledBoxes, MultiBernoulli, PoissonMultiBernoulli, set_nll
from foredrive.sets.assignment import best_assignment

NO_OBJECT_WEIGHT = 0.1
BOX_WEIGHT, HEADING_WEIGHT = 0.5, 0.5
STATE_SCALE = (1.0, 1.0, 1.0, 0.3, 0.3, 0.3)
"""Errors of this size, in m and log m, have equal weight."""

Sample = tuple[Float[Tensor, "D Z Y X"], LabelledBoxes]
"""A volume and its labelled objects."""
Loss = Callable[[BoxSet, LabelledBoxes], Float[Tensor, ""]]
"""The loss of one frame: `matching_loss` or `set_loss`."""


def fit_head(
    head: DetectionHead,
    samples: Sequence[Sample],
    loss: Loss,
    *,
    steps: int,
    batch: int = 8,
    learning_rate: float = 1e-3,
    seed: int = 0,
) -> DetectionHead:
    """Train a copy of the head with a one-cycle learning rate. Return the copy.

    Raises:
        InputError: there are fewer samples than a batch holds.
    """
    if len(samples) < batch:
        raise InputError(f"{len(samples)} samples are fewer than a batch of {batch}")
    head = copy.deepcopy(head).train()
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.AdamW(head.parameters(), learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, learning_rate, total_steps=steps)
    for _ in range(steps):
        chosen = [samples[n] for n in rng.choice(len(samples), batch, replace=False)]
        optimizer.zero_grad()
        found = head(torch.stack([volume for volume, _ in chosen]))
        torch.stack([loss(found[n], truth) for n, (_, truth) in enumerate(chosen)]).mean().backward()
        torch.nn.utils.clip_grad_norm_(head.parameters(), 10.0)
        optimizer.step()
        schedule.step()
    return head.eval()


def said_of(head: DetectionHead, volumes: Sequence[Float[Tensor, "D Z Y X"]]) -> list[MultiBernoulli]:
    """Return the output of the head for each volume, in float64 and without gradients."""
    with torch.no_grad():
        return [
            as_multi_bernoulli(head(volume[None])[0].map_tensors(torch.Tensor.double)) for volume in volumes
        ]


def as_multi_bernoulli(found: BoxSet) -> MultiBernoulli:
    """Return the boxes of one frame as a random finite set.

    It is built from logits, so no precision is lost where r is close to 1.
    """
    boxes = BoxDensity(
        mean=found.mean,
        chol=torch.diag_embed(found.log_std.exp()),
        yaw=torch.atan2(found.heading[..., 0], found.heading[..., 1]),
        concentration=(-2 * found.log_std_yaw).exp(),
    )
    return MultiBernoulli.from_softmax(found.logits, boxes)


def set_loss(found: BoxSet, truth: LabelledBoxes) -> Float[Tensor, ""]:
    """Return the MB-NLL of one frame per object. All associations count by their likelihood."""
    pmb = PoissonMultiBernoulli(as_multi_bernoulli(found))
    return set_nll(pmb, truth).nll / max(len(truth.label), 1)


def matching_loss(found: BoxSet, truth: LabelledBoxes) -> Float[Tensor, ""]:
    """Return the DETR loss of one frame per object: cross-entropy and L1 of the best matching.

    Standard deviations are learned from the Gaussian likelihood of matched boxes with fixed means, as in
    probabilistic detectors trained by matching.
    """
    assert truth.yaw is not None
    query, match = _best_matching(found, truth)
    objects = max(len(truth.label), 1)
    classes = found.logits.shape[-1] - 1
    target = torch.full(found.logits.shape[:1], classes, device=found.logits.device)
    target[query] = truth.label[match].long()
    weight = torch.where(target == classes, NO_OBJECT_WEIGHT, 1.0)
    entropy = (F.cross_entropy(found.logits, target, reduction="none") * weight).sum()
    state = truth.state[match].to(found.mean)
    error = (found.mean[query] - state).abs() / found.mean.new_tensor(STATE_SCALE)
    yaw = truth.yaw[match].to(found.mean)
    arrow = torch.stack([yaw.sin(), yaw.cos()], dim=-1)
    turn = (found.heading[query] - arrow).abs().sum()
    log_std = found.log_std[query]
    z = (found.mean[query].detach() - state) / log_std.exp()
    log_std_yaw = found.log_std_yaw[query]
    cos = (found.heading[query].detach() * arrow).sum(-1)
    spread = (0.5 * z.square() + log_std).sum() + (log_std_yaw + (1 - cos) * (-2 * log_std_yaw).exp()).sum()
    return (entropy + BOX_WEIGHT * error.sum() + HEADING_WEIGHT * turn + 0.1 * spread) / objects


def _best_matching(found: BoxSet, truth: LabelledBoxes) -> tuple[Tensor, Tensor]:
    """Return matched queries and objects. Each object has one query."""
    with torch.no_grad():
        class_cost = -found.logits.softmax(-1)[:, truth.label.long()]
        scale = found.mean.new_tensor(STATE_SCALE)
        apart = (found.mean[:, None] - truth.state.to(found.mean)) / scale
        cost = (class_cost + BOX_WEIGHT * apart.abs().sum(-1)).T.double().cpu().numpy()
    dear = np.full(len(cost), 1.0 + 2.0 * np.abs(cost).sum())  # match every object while queries last
    column = torch.as_tensor(best_assignment(cost, dear).column)
    match = (column >= 0).nonzero()[:, 0]
    return column[match].to(found.mean.device), match.to(found.mean.device)
