"""Gaussians as nodes of a 3-D scene that the browser draws: their albedo, without the decoders."""

import numpy as np
import torch
import viser
from jaxtyping import Float
from torch import Tensor

from foredrive.rendering.gaussians import Gaussians

MAX_STD_M = 200.0
"""Maximum standard deviation, m: the browser keeps variances in half precision, which ends at 65504."""
MIN_OPACITY = 1 / 255
"""Minimum opacity of a visible Gaussian at its centre."""
MIN_DISTANCE_M = 5.0
"""Minimum distance in the estimate of coverage, m; nearer Gaussians count as if at this distance."""


def thin_out(gaussians: Gaussians, share: float, from_m: Float[Tensor, "K 3"]) -> Gaussians:
    """Choose the visible Gaussians that cover most, by opacity, largest section and distance.

    Args:
        gaussians: in any frame.
        share: maximum share of the Gaussians that is kept.
        from_m: viewpoints, in the frame of the Gaussians; of two equal Gaussians the farther covers less.
    """
    opacity = gaussians.opacity_logit.sigmoid()
    seen = (opacity >= MIN_OPACITY).nonzero()[:, 0]
    max_count = round(share * len(opacity))
    if len(seen) > max_count:
        scale_m = gaussians.log_scale.exp().sort(dim=-1).values
        range_m = torch.cdist(gaussians.mean_m, from_m).amin(-1).clamp_min(MIN_DISTANCE_M)
        covers = opacity * scale_m[:, 1] * scale_m[:, 2] / range_m**2
        seen = seen[covers[seen].topk(max_count).indices].sort().values
    return gaussians[seen]


@torch.no_grad()
def show_splats(scene: viser.SceneApi, name: str, gaussians: Gaussians) -> viser.GaussianSplatHandle:
    """Draw Gaussians in the frame of the parent node."""
    factor = gaussians.factor().permute(2, 0, 1)
    held = (MAX_STD_M / gaussians.log_scale.exp().amax(-1)).clamp_max(1.0)
    factor = factor * held[:, None, None]
    return scene.add_gaussian_splats(
        name,
        centers=_array(gaussians.mean_m),
        covariances=_array(factor @ factor.transpose(-1, -2)),
        rgbs=_array(gaussians.feature[:, :3].clamp(0, 1)),
        opacities=_array(gaussians.opacity_logit.sigmoid()[:, None]),
    )


def _array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()
