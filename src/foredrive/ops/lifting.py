"""Multi-camera deformable attention: what 3-D queries read from image features (NeMo eq. 1)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.ops.precision import full_precision


def lift(
    values: Sequence[Float[Tensor, "b C _h _w D"]],
    uv: Float[Tensor, "b C Q 2"],
    visible: Bool[Tensor, "b C Q"],
    offsets: Float[Tensor, "b Q H L P 2"],
    weights: Float[Tensor, "b Q H L P"],
) -> Float[Tensor, "b Q D"]:
    """Multi-head deformable cross-attention to L levels of image features of C cameras.

    Zhu et al. 2021, eq. 2, over several cameras as in BEVFormer: a query reads every camera that sees it and
    takes the mean over these; a query that no camera sees reads 0. Head h reads channels
    [h·D/H, (h+1)·D/H) at uv·(w, h) + offset, bilinearly, zero outside the feature map.

    Args:
        values: feature maps, channels last, finest first or in any other order.
        uv: where each query falls in each image, as a share of its width and height: (0, 0) is the top left
            corner of the top left pixel, (1, 1) the bottom right one of the bottom right pixel. Calibration:
            no gradient flows to it. Ignored where not visible.
        visible: which cameras see which query.
        offsets: in pixels of the level's own feature map, x y.
        weights: attention weights, already normalised over L·P.

    Returns:
        float32 (float64 for float64 input), also from half precision.

    Raises:
        ValueError: if D is not a multiple of H or shapes do not agree.
    """
    _check(values, uv, visible, offsets, weights)
    return lift_reference(values, uv, visible, offsets, weights)


def lift_reference(
    values: Sequence[Float[Tensor, "b C _h _w D"]],
    uv: Float[Tensor, "b C Q 2"],
    visible: Bool[Tensor, "b C Q"],
    offsets: Float[Tensor, "b Q H L P 2"],
    weights: Float[Tensor, "b Q H L P"],
) -> Float[Tensor, "b Q D"]:
    """`lift` in plain PyTorch: samples every camera for every query, then masks."""
    with full_precision(*values, uv, offsets, weights) as (*values, uv, offsets, weights):
        b, cameras, _ = visible.shape
        heads = offsets.shape[2]
        uv = uv.detach().masked_fill(~visible[..., None], 0.5)
        total = values[0].new_zeros(())
        for level, value in enumerate(values):
            height, width = value.shape[2:4]
            size_wh = uv.new_tensor([width, height])
            place = (uv * size_wh)[:, :, None, :, None] + offsets[:, None, :, :, level].transpose(2, 3)
            grid = 2 * place.clamp(-uv.new_ones(2), size_wh + 1) / size_wh - 1  # [b C H Q P 2]
            maps = value.unflatten(-1, (heads, -1)).permute(0, 1, 4, 5, 2, 3)  # [b C H D/H h w]
            read = F.grid_sample(maps.flatten(0, 2), grid.flatten(0, 2), align_corners=False)
            read = read.unflatten(0, (b, cameras, heads))  # [b C H D/H Q P]
            read = read.masked_fill(place.isnan().any(-1)[:, :, :, None], torch.nan)
            total = total + (read * weights[:, None, :, :, level].transpose(2, 3)[:, :, :, None]).sum(-1)
        seen = total.masked_fill(~visible[:, :, None, None], 0).sum(1)  # [b H D/H Q]
        mean = seen / visible.sum(1).clamp_min(1)[:, None, None]
        return mean.permute(0, 3, 1, 2).flatten(2)


def _check(values: Sequence[Tensor], uv: Tensor, visible: Tensor, offsets: Tensor, weights: Tensor) -> None:
    """Refuse shapes that do not fit together: the kernels index by them."""
    b, cameras, queries = visible.shape
    heads, levels, points = offsets.shape[2:5]
    channels = values[0].shape[-1] if values else 0
    fits = (
        len(values) == levels > 0
        and all(v.shape[:2] == (b, cameras) and v.shape[4:] == (channels,) for v in values)
        and uv.shape == (b, cameras, queries, 2)
        and offsets.shape == (b, queries, heads, levels, points, 2)
        and weights.shape == (b, queries, heads, levels, points)
        and channels % heads == 0
    )
    if not fits:
        shapes = {
            "values": [tuple(v.shape) for v in values],
            "uv": tuple(uv.shape),
            "visible": tuple(visible.shape),
            "offsets": tuple(offsets.shape),
            "weights": tuple(weights.shape),
        }
        raise ValueError(f"lift: shapes do not fit together (D must be a multiple of H): {shapes}")
