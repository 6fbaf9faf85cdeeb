"""Changes of the number and places of Gaussians during training, together with their optimizer state."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.optim import Optimizer

from foredrive.rendering.gaussians.relocation import MAX_COPIES, MIN_OPACITY, split_evenly
from foredrive.rendering.gaussians.scene import GAUSSIAN_PARAMETERS, GaussianScene


@torch.no_grad()
def relocate(scene: GaussianScene, optimizer: Optimizer, generator: torch.Generator) -> int:
    """Move every dead Gaussian to a live one, drawn by opacity. Return how many were moved.

    Both then render together as the live one did, and start without momentum.
    """
    opacity = scene.opacity_logit.sigmoid()
    dead = (opacity <= MIN_OPACITY).nonzero()[:, 0]
    alive = (opacity > MIN_OPACITY).nonzero()[:, 0]
    if len(dead) == 0 or len(alive) == 0:
        return 0
    chosen = alive[_drawn(opacity[alive], len(dead), generator)]
    _share(scene, chosen)
    for name in GAUSSIAN_PARAMETERS:
        parameter = getattr(scene, name)
        parameter[dead] = parameter[chosen]
        _forget(optimizer, parameter, torch.cat([dead, chosen]))
    scene.actor[dead] = scene.actor[chosen]
    return len(dead)


@torch.no_grad()
def grow(
    scene: GaussianScene, optimizer: Optimizer, most: int, share: float, generator: torch.Generator
) -> int:
    """Add a share of new Gaussians, up to `most` in total. Return how many were added.

    Each is placed on one drawn by opacity, as in `relocate`.
    """
    count = min(int((1 + share) * len(scene.actor)), most) - len(scene.actor)
    if count <= 0:
        return 0
    chosen = _drawn(scene.opacity_logit.sigmoid(), count, generator)
    _share(scene, chosen)
    for name in GAUSSIAN_PARAMETERS:
        old = getattr(scene, name)
        new = nn.Parameter(torch.cat([old, old[chosen]]))
        _forget(optimizer, old, chosen)
        _replace(optimizer, old, new)
        setattr(scene, name, new)
    scene.actor = torch.cat([scene.actor, scene.actor[chosen]])
    return count


def _drawn(weight: Float[Tensor, "N"], count: int, generator: torch.Generator) -> Int[Tensor, "count"]:
    """Draw rows by weight, with replacement. torch.multinomial takes no more than 2**24 rows."""
    total = weight.double().cumsum(0).cpu()
    at = torch.rand(count, generator=generator, dtype=torch.float64) * total[-1]
    return torch.searchsorted(total, at).clamp_max(len(total) - 1).to(weight.device)


def _share(scene: GaussianScene, chosen: Int[Tensor, "count"]) -> None:
    """Lower opacity and scale of the chosen Gaussians, so that with their copies they render as before."""
    rows, copies = chosen.unique(return_counts=True)
    opacity, scale = split_evenly(scene.opacity_logit[rows].sigmoid(), (copies + 1).clamp_max(MAX_COPIES))
    scene.opacity_logit[rows] = opacity.clamp(MIN_OPACITY, 1 - 1e-6).logit()
    scene.log_scale[rows] += scale.log()[:, None]


def _forget(optimizer: Optimizer, parameter: nn.Parameter, rows: Int[Tensor, "_"]) -> None:
    for value in optimizer.state[parameter].values():
        if value.shape == parameter.shape:
            value[rows] = 0


def _replace(optimizer: Optimizer, old: nn.Parameter, new: nn.Parameter) -> None:
    """Continue the optimizer with a longer parameter."""
    state = optimizer.state.pop(old, {})
    optimizer.state[new] = {
        name: torch.cat([value, value.new_zeros(len(new) - len(old), *value.shape[1:])])
        if value.shape == old.shape
        else value
        for name, value in state.items()
    }
    for group in optimizer.param_groups:
        group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
