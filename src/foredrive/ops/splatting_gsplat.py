"""The CUDA path of `composite_splats` for cameras: gsplat 1.5 (Ye et al., "gsplat", 2024).

Its opacity thresholds and pixel centres are the same as here. It has no time, no range slope and no median.
Never run on a card (`docs/how-to/other-tools.md`).
"""

import functools
import importlib
import logging
import math

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.ops.splat_points import SIDE_PX

_log = logging.getLogger(__name__)


@functools.cache
def gsplat_compiles() -> bool:
    """Return whether gsplat's kernels are there; say once what is missing otherwise.

    gsplat comes as source. It builds its kernels at the first import, with the CUDA toolkit's nvcc, which
    takes minutes; without nvcc the import succeeds, and every call would fail.
    """
    try:
        built = importlib.import_module("gsplat.cuda._backend")._C is not None
        reason = "gsplat has found no nvcc to build its kernels with"
    except ImportError:
        built, reason = False, "gsplat is not installed (pip install 'foredrive[gsplat]')"
    except (OSError, RuntimeError) as error:
        built, reason = False, f"gsplat's kernels could not be built ({str(error).splitlines()[0]})"
    if not built:
        _log.warning("%s: images of Gaussians are made in plain PyTorch, which is slow on a GPU", reason)
    return built


def composite_gsplat(
    mean: Float[Tensor, "N 2"],
    inverse_covariance: Float[Tensor, "N 3"],
    opacity: Float[Tensor, "N"],
    range_m: Float[Tensor, "N"],
    feature: Float[Tensor, "N D"],
    size_hw: tuple[int, int],
) -> tuple[Float[Tensor, "P D"], Float[Tensor, "P"], Float[Tensor, "P"]]:
    """Return features, expected range and alpha of all pixels in row order; see `Splats` for the rest."""
    from gsplat import isect_offset_encode, isect_tiles, rasterize_to_pixels

    height, width = size_hw
    rows, columns = -(-height // SIDE_PX), -(-width // SIDE_PX)
    # Lists of splats per tile, sorted by tile and depth
    _, ids, splat = isect_tiles(
        mean[None],
        _extent_px(inverse_covariance, opacity)[None],
        range_m[None],
        SIDE_PX,
        columns,
        rows,
    )
    # The range is composited as one more feature channel
    image, alpha = rasterize_to_pixels(
        mean[None],
        inverse_covariance[None].contiguous(),
        torch.cat([feature, range_m[:, None]], -1)[None],
        opacity[None],
        width,
        height,
        SIDE_PX,
        isect_offset_encode(ids, 1, columns, rows),
        splat,
    )
    flat = image[0].flatten(0, 1)
    return flat[:, :-1], flat[:, -1], alpha[0].flatten()


@torch.no_grad()
def _extent_px(inverse_covariance: Float[Tensor, "N 3"], opacity: Float[Tensor, "N"]) -> Tensor:
    """Return the distance along u and v at which the opacity falls to 1/255, whole px; 0 if it is lower."""
    xx, xy, yy = inverse_covariance.unbind(-1)
    # o exp(-x / 2) = 1/255 gives x; the ellipse reaches √(x · yy / det A) along u
    square = 2 * (opacity.clamp(min=1e-30).log() + math.log(255)).clamp(min=0) / (xx * yy - xy * xy)
    return (square[:, None] * torch.stack([yy, xx], -1)).sqrt().ceil().int()
