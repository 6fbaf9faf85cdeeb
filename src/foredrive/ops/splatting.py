"""Compositing of projected Gaussians on pixels and beams.

Sources: Kerbl et al., "3D Gaussian Splatting", 2023; Hess et al., "SplatAD", 2025.

At a point p with measurement time t, a splat has the opacity

    α = min(o · exp(-dᵀ A d / 2), 0.999),   d = p - mean - velocity · t,

and the range r = range + slope · d + range rate · t. Splats are values in the order of `range_m`. A splat
with α < 1/255 is skipped. The first splat that would reduce the transmittance to 1e-4 or less ends the ray
and is not counted.
"""

import math
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.geometry.precision import full_precision
from foredrive.ops.precision import numba_supports
from foredrive.ops.splat_points import TiledPoints

MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4
BeforeHit = Literal["weights", "opacities"]
"""The sum over the splats nearer than a hit: "weights" adds their weights, and compares their ranges at the
point. "opacities" adds their opacities at the point, without the transmittance, and compares the ranges of
their centres at time 0 (SplatAD's reference implementation).
"""
REFERENCE_SIZE = 2**21
"""Maximum number of (point, splat) pairs that plain PyTorch processes at once."""


class Splats(NamedTuple):
    """N Gaussians projected to the plane of a sensor, in any order. Lengths on the plane are in px or rad."""

    mean: Float[Tensor, "N 2"]
    """Centre at time 0."""
    inverse_covariance: Float[Tensor, "N 3"]
    """Entries xx, xy, yy of the matrix A."""
    opacity: Float[Tensor, "N"]
    """Peak opacity o, 0 to 1."""
    range_m: Float[Tensor, "N"]
    """Range of the centre at time 0: depth along the optical axis of a camera, or range of a lidar."""
    range_slope: Float[Tensor, "N 2"]
    """Change of range over the plane, m per px or rad."""
    velocity: Float[Tensor, "N 2"]
    """Velocity of the centre on the plane, px/s or rad/s."""
    range_rate_mps: Float[Tensor, "N"]
    feature: Float[Tensor, "N D"]


class Composited(NamedTuple):
    """Result at P points. The weight of a splat is α times the transmittance in front of it."""

    feature: Float[Tensor, "P D"]
    """Σ weight · feature. Over a background b, the feature is this plus (1 - alpha) · b."""
    expected_range_m: Float[Tensor, "P"]
    """Σ weight · range. Divide by `alpha` for the range of the rays that end."""
    median_range_m: Float[Tensor, "P"]
    """Range of the splat at which the transmittance falls to one half or less. It is infinite if there is
    none, and NaN if not requested. It has no gradient."""
    alpha: Float[Tensor, "P"]
    """Σ weight, the probability that the ray ends."""
    alpha_before_hit: Float[Tensor, "P"] | None
    """Σ over the splats nearer than the hit, see `BeforeHit`. None if no hits are given."""


class SplatLists(NamedTuple):
    """Lists of the splats that touch each tile."""

    splat: Int[Tensor, "L"]
    """Splat indices, tile after tile, front to back within a tile."""
    first: Int[Tensor, "T1"]
    """Start of the list of each tile, and L at the end."""


def composite_splats(
    splats: Splats,
    points: TiledPoints,
    hit_range_m: Float[Tensor, "P"] | None = None,
    *,
    median: bool = True,
    before_hit: BeforeHit = "weights",
) -> Composited:
    """Composite the splats at all points.

    Gradients reach every field of `splats`. On a GPU, gsplat renders images of one instant if the median
    range is not requested and its kernels are there (`gsplat_compiles`). All other cases on a GPU use plain
    PyTorch.

    Args:
        points: result of `pixel_points` or `beam_points`, on the device of the splats.
        hit_range_m: range of the lidar return minus a margin; infinite if there is no return. It is needed
            for `alpha_before_hit`.
        median: whether to compute `median_range_m`; without it the field is NaN.
        before_hit: what `alpha_before_hit` adds up.

    Raises:
        ValueError: values are not finite, or the number of hits is not that of the points.
    """
    _check(splats, points, hit_range_m)
    if splats.mean.is_cuda and points.single_instant and hit_range_m is None and not median:
        from foredrive.ops.splatting_gsplat import gsplat_compiles  # It is optional

        if gsplat_compiles():
            return _composite_image(splats, points)
    result = _composite(splats, points, hit_range_m, before_hit)
    return result if median else result._replace(median_range_m=torch.full_like(result.alpha, math.nan))


def _composite_image(splats: Splats, points: TiledPoints) -> Composited:
    from foredrive.ops.splatting_gsplat import composite_gsplat  # it is optional

    assert points.size_hw is not None
    # gsplat composites any channels; the range is one more of them
    with full_precision(*splats) as fields:
        splats = Splats(*fields)
        feature, expected_m, alpha = composite_gsplat(
            splats.mean,
            splats.inverse_covariance,
            splats.opacity,
            splats.range_m,
            splats.feature,
            points.size_hw,
        )
    return Composited(feature, expected_m, torch.full_like(alpha.detach(), math.nan), alpha, None)


def _composite(
    splats: Splats, points: TiledPoints, hit_range_m: Float[Tensor, "P"] | None, before_hit: BeforeHit
) -> Composited:
    if not numba_supports(*splats):
        return composite_splats_reference(splats, points, hit_range_m, before_hit=before_hit)
    from foredrive.ops.splatting_numba import CompositeSplats  # numba is slow to import

    hits = torch.zeros(points.count) if hit_range_m is None else hit_range_m.detach().float()
    fields = (field.float() for field in splats)
    by_centre = before_hit == "opacities"
    out = CompositeSplats.apply(points.to("cpu", torch.float32), hits, by_centre, *fields)
    return _composited(out, hit_range_m is not None)


def composite_splats_reference(
    splats: Splats,
    points: TiledPoints,
    hit_range_m: Float[Tensor, "P"] | None = None,
    lists: SplatLists | None = None,
    before_hit: BeforeHit = "weights",
) -> Composited:
    """Compute `composite_splats` in plain PyTorch, on the lists of `list_splats` if no others are given."""
    lists = lists or list_splats(splats, points)
    points = points.to(splats.mean.device, splats.mean.dtype)
    lengths = lists.first.diff()
    hits = splats.range_m.new_zeros(points.count) if hit_range_m is None else hit_range_m
    # Features, then expected range, median range, alpha, alpha before the hit
    columns = splats.feature.shape[1] + 4
    out = splats.feature.new_zeros(points.count, columns)
    tiles = lengths.argsort(descending=True)  # lists of similar lengths together: little padding
    while len(tiles):
        max_length = int(lengths[tiles[0]])
        # As many tiles at once as the memory limit allows for the longest list
        chunk, tiles = tiles.split([n := min(_chunk(points, max_length), len(tiles)), len(tiles) - n])
        index = points.index[chunk].flatten()
        values = _composite_tiles(splats, points, hits, lists, chunk, max_length, before_hit).flatten(0, 1)
        # Empty slots have index -1 and are dropped
        out = out.index_copy(0, index[index >= 0], values[index >= 0])
    return _composited(out, hit_range_m is not None)


def _composited(out: Float[Tensor, "P D4"], has_hits: bool) -> Composited:
    expected, median, alpha, before = out[:, -4:].unbind(1)
    return Composited(out[:, :-4], expected, median.detach(), alpha, before if has_hits else None)


def _chunk(points: TiledPoints, max_length: int) -> int:
    """Return the number of tiles that plain PyTorch processes at once."""
    return max(REFERENCE_SIZE // (max(max_length, 1) * points.index.shape[1]), 1)


def _composite_tiles(
    splats: Splats,
    points: TiledPoints,
    hit_range_m: Float[Tensor, "P"],
    lists: SplatLists,
    tiles: Int[Tensor, "C"],
    max_length: int,
    before_hit: BeforeHit,
) -> Float[Tensor, "C S D4"]:
    """Return, per slot: feature, expected range, median range, alpha, alpha before the hit."""
    # Entries of each tile's list, padded to the longest
    place = lists.first[tiles, None] + torch.arange(max_length, device=tiles.device)  # [C L]
    listed = (place < lists.first[tiles + 1, None])[:, None]
    chosen = lists.splat[place.clamp(max=len(lists.splat) - 1)]
    position, time_s = points.position[tiles], points.time_s[tiles, :, None]
    # Offset d of each point from each splat at the point's time
    mean = _nearest_image(splats.mean[chosen], position, points.period)[:, None]
    offset = position[:, :, None] - mean - splats.velocity[chosen][:, None] * time_s[..., None]  # [C S L 2]
    dx, dy = offset.unbind(-1)
    xx, xy, yy = splats.inverse_covariance[chosen][:, None].unbind(-1)
    # α = o exp(-dᵀ A d / 2), limited to 0.999 and dropped below 1/255
    exponent = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    alpha = (splats.opacity[chosen][:, None] * exponent.clamp(max=0).exp()).clamp(max=MAX_ALPHA)
    alpha = torch.where(listed & (alpha >= MIN_ALPHA), alpha, 0.0)
    # Transmittance behind and in front of each splat
    passed = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(passed[..., :1]), passed[..., :-1]], -1)
    # A ray ends before the splat that would take its transmittance to 1e-4
    weight = torch.where(passed > MIN_TRANSMITTANCE, alpha * before, 0.0)
    # Range at the point: slope over the plane, and motion until the point's time
    range_m = splats.range_m[chosen][:, None] + (splats.range_slope[chosen][:, None] * offset).sum(-1)
    range_m = range_m + splats.range_rate_mps[chosen][:, None] * time_s
    # The splat at which the transmittance falls through one half (infinite if none does)
    half = (weight > 0) & (before > 0.5) & (passed <= 0.5)
    median = F.pad(torch.where(half, range_m.detach(), math.inf), (0, 1), value=math.inf).amin(-1)
    hit = hit_range_m[points.index[tiles].clamp(min=0)][..., None]
    # SplatAD compares centres and adds opacities; "weights" compares ranges at the point
    if before_hit == "opacities":
        alpha = torch.where(passed > MIN_TRANSMITTANCE, alpha, 0.0)
        nearer = (alpha * (splats.range_m[chosen][:, None] < hit)).sum(-1)
    else:
        nearer = (weight * (range_m < hit)).sum(-1)
    sums = (weight * range_m).sum(-1), median, weight.sum(-1), nearer
    return torch.cat([weight @ splats.feature[chosen], torch.stack(sums, -1)], -1)


@torch.no_grad()
def list_splats(splats: Splats, points: TiledPoints) -> SplatLists:
    """Return, for each tile, the splats whose opacity reaches 1/255 in the box around its points."""
    points = points.to(splats.mean.device, splats.mean.dtype)
    low, high = points.tile_bounds[:, 0::2], points.tile_bounds[:, 1::2]  # [T 3]: x y time
    tiles, count = len(low), len(splats.opacity)
    # From o exp(-x / 2) = 1/255
    max_exponent = 2 * (splats.opacity / MIN_ALPHA).clamp(min=1e-30).log()  # largest dᵀ A d that counts
    # Front to back, without splats that are too faint everywhere
    order = splats.range_m.argsort(stable=True)
    order = order[max_exponent[order] >= 0]
    splat_ids, tile_of = [], []
    for start in range(0, tiles, step := max(REFERENCE_SIZE // max(count, 1), 1)):
        touched = _touches(
            splats, order, max_exponent, low[start : start + step], high[start : start + step], points
        )
        # Row-major: tile by tile, and front to back within each tile
        tile, rank = touched.nonzero(as_tuple=True)
        splat_ids.append(order[rank])
        tile_of.append(tile + start)
    empty = torch.zeros(0, dtype=torch.long, device=splats.mean.device)
    in_tile = torch.cat([empty, *tile_of]).bincount(minlength=tiles)
    return SplatLists(torch.cat([empty, *splat_ids]), torch.cat([in_tile.new_zeros(1), in_tile.cumsum(0)]))


def _touches(
    splats: Splats,
    chosen: Int[Tensor, "M"],
    max_exponent: Float[Tensor, "N"],
    low: Float[Tensor, "C 3"],
    high: Float[Tensor, "C 3"],
    points: TiledPoints,
) -> Bool[Tensor, "C M"]:
    """Return whether the ellipses dᵀ A d ≤ max_exponent of splats reach boxes in x, y and time."""
    # Offsets of the box from the mean, enlarged by the motion over the box' time interval
    mean = splats.mean[chosen].expand(len(low), -1, -1)
    mean = _nearest_image(mean, torch.stack([low[:, :2], high[:, :2]], 1), points.period)
    moved = splats.velocity[chosen] * torch.stack([low[:, 2:], high[:, 2:]])[..., None]  # [2 C M 2]
    x0, y0 = (low[:, None, :2] - mean - moved.amax(0)).unbind(-1)
    x1, y1 = (high[:, None, :2] - mean - moved.amin(0)).unbind(-1)
    xx, xy, yy = splats.inverse_covariance[chosen].unbind(-1)
    # Offset of the box nearest to 0 along each axis
    near_x, near_y = x0.clamp(min=0) + x1.clamp(max=0), y0.clamp(min=0) + y1.clamp(max=0)
    along_y = torch.minimum(torch.maximum(-xy / yy * near_x, y0), y1)  # the minimum on the nearest side
    along_x = torch.minimum(torch.maximum(-xy / xx * near_y, x0), x1)
    # A quadratic form has its minimum over a box on the nearest sides, or at 0 if the box contains it
    min_exponent = torch.minimum(
        xx * near_x * near_x + 2 * xy * near_x * along_y + yy * along_y * along_y,
        xx * along_x * along_x + 2 * xy * along_x * near_y + yy * near_y * near_y,
    )
    # A small tolerance: the float32 bounds may be rounded to the wrong side
    return min_exponent <= max_exponent[chosen] * (1 + 1e-5) + 1e-5


def _nearest_image(
    mean: Float[Tensor, "C L 2"], position: Float[Tensor, "C S 2"], period: float
) -> Float[Tensor, "C L 2"]:
    """Return the means shifted by whole periods to be nearest to the middle of their tile."""
    if not period:
        return mean
    x = position[..., 0].detach()
    middle = 0.5 * (x.amin(1) + x.amax(1))[:, None]
    # Whole turns carry no gradient
    turns = ((middle - mean[..., 0].detach()) / period).round()
    return torch.stack([mean[..., 0] + period * turns, mean[..., 1]], -1)


def _check(splats: Splats, points: TiledPoints, hit_range_m: Tensor | None) -> None:
    # A finite sum proves that all values are finite and is cheaper than the exact test
    for name, value in splats._asdict().items():
        if not value.detach().sum().isfinite() and not (finite := value.isfinite()).all():
            bad = int((~finite).flatten(1).any(1).sum() if value.dim() > 1 else (~finite).sum())
            raise ValueError(f"{name} of {bad} of {len(value)} splats is not finite")
    if hit_range_m is not None and len(hit_range_m) != points.count:
        raise ValueError(f"{len(hit_range_m)} hits for {points.count} points")
    if hit_range_m is not None and hit_range_m.isnan().any():
        raise ValueError(f"hit_range_m of {int(hit_range_m.isnan().sum())} points is NaN")
