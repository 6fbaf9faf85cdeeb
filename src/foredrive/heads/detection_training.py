"""Training and inference of a detection head."""

import copy
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.engine.parameter_groups import parameter_groups
from foredrive.errors import InputError
from foredrive.heads.detection_losses import Loss
from foredrive.heads.detection_network import DetectionHead
from foredrive.sets import LabelledBoxes, MultiBernoulli

Sample = tuple[Float[Tensor, "D Z Y X"], LabelledBoxes]
"""A volume and its labelled objects."""


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
        InputError: there are fewer samples than a batch holds, or the loss of a sample is not finite.
    """
    if len(samples) < batch:
        raise InputError(f"{len(samples)} samples are fewer than a batch of {batch}")
    head = copy.deepcopy(head).train()
    rng = np.random.default_rng(seed)
    # Weight decay acts on some parameters only (see `parameter_groups`)
    optimizer = torch.optim.AdamW(parameter_groups(head, weight_decay=1e-2), learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, learning_rate, total_steps=steps)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)  # for losses that draw samples
        for _ in range(steps):
            chosen = rng.choice(len(samples), batch, replace=False).tolist()
            optimizer.zero_grad()
            predicted = head(torch.stack([samples[n][0] for n in chosen]))
            losses = [loss(predicted[place], samples[n][1]) for place, n in enumerate(chosen)]
            _check_finite(losses, chosen, samples, queries=len(head.middle_m))
            # A frame without a finite loss stops the training with its cause
            torch.stack(losses).mean().backward()
            torch.nn.utils.clip_grad_norm_(head.parameters(), 10.0)
            optimizer.step()
            schedule.step()
    return head.eval()


def _check_finite(
    losses: Sequence[Float[Tensor, ""]], chosen: Sequence[int], samples: Sequence[Sample], queries: int
) -> None:
    for value, n in zip(losses, chosen, strict=True):
        if not value.isfinite():
            objects = len(samples[n][1].label)
            cause = "; without a background, each object needs a query" if objects > queries else ""
            raise InputError(
                f"sample {n} of {objects} objects has the loss {value.item()} with {queries} queries{cause}"
            )


def predict_sets(head: DetectionHead, volumes: Sequence[Float[Tensor, "D Z Y X"]]) -> list[MultiBernoulli]:
    """Return the output of the head for each volume, in float64 and without gradients."""
    with torch.no_grad():
        return [
            head(volume[None])[0].map_tensors(torch.Tensor.double).as_multi_bernoulli() for volume in volumes
        ]
