"""The CUDA path of `cross_boxes`: a program tests some rays against all boxes.

Never run on a card, but in Triton's interpreter (`docs/how-to/other-tools.md`).
"""

from collections.abc import Sequence
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Int
from torch import Tensor

RAYS = 64
"""Rays of a program."""


def crossing_pairs_triton(keys: Sequence[Tensor]) -> Int[Tensor, "P 2"]:
    """Return the crossing pairs (ray, box), in order of entry.

    `keys` are the parts of `ray_boxes.KeyPoses`. The kernel writes the distance of entry of each ray and box,
    R · A numbers, infinite where a ray misses.
    """
    origin, position, shown = keys[0], keys[4], keys[8]
    rays, boxes, times = len(origin), *position.shape[:2]
    enter = torch.empty(rays, boxes, device=origin.device)
    _enter_boxes[(triton.cdiv(rays, RAYS),)](
        *keys[:8],
        shown.to(torch.uint8),
        enter,
        rays,
        boxes,
        times,
        shown.shape[1],
        RAYS=RAYS,
    )
    # Sort each ray's boxes by distance of entry. Misses are infinite and go to the end
    order = enter.argsort(dim=1, stable=True)
    ray, place = enter.gather(1, order).isfinite().nonzero(as_tuple=True)
    return torch.stack([ray, order[ray, place]], dim=-1)


@triton.jit
@no_type_check
def _into(rotation, x, y, z):
    """Return Rᵀ v for one matrix."""
    return (
        tl.load(rotation) * x + tl.load(rotation + 3) * y + tl.load(rotation + 6) * z,
        tl.load(rotation + 1) * x + tl.load(rotation + 4) * y + tl.load(rotation + 7) * z,
        tl.load(rotation + 2) * x + tl.load(rotation + 5) * y + tl.load(rotation + 8) * z,
    )


@triton.jit
@no_type_check
def _turned(x, y, z, ux, uy, uz, c, s):
    # Rodrigues' rotation about the unit vector u; c and s are cosine and sine of the angle
    along = (ux * x + uy * y + uz * z) * (1 - c)
    return (
        c * x + s * (uy * z - uz * y) + along * ux,
        c * y + s * (uz * x - ux * z) + along * uy,
        c * z + s * (ux * y - uy * x) + along * uz,
    )


@triton.jit
@no_type_check
def _slab(q, e, half, near, far):
    # A parallel ray is between the planes everywhere or nowhere; `safe` avoids the division by zero
    parallel = e == 0
    safe = tl.where(parallel, 1.0, e)
    a, b = (-half - q) / safe, (half - q) / safe
    outside = tl.abs(q) > half
    low = tl.where(parallel, tl.where(outside, float("inf"), float("-inf")), tl.minimum(a, b))
    high = tl.where(parallel, tl.where(outside, float("-inf"), float("inf")), tl.maximum(a, b))
    return tl.maximum(near, low), tl.minimum(far, high)


@triton.jit
@no_type_check
def _row_of(tensor, row, inside):
    x = tl.load(tensor + 3 * row, mask=inside, other=0.0)
    y = tl.load(tensor + 3 * row + 1, mask=inside, other=0.0)
    return x, y, tl.load(tensor + 3 * row + 2, mask=inside, other=0.0)


@triton.jit
@no_type_check
def _enter_boxes(
    origin,  # R 3
    direction,  # R 3
    segment,  # R
    share,  # R
    position,  # A K 3
    rotation,  # A K 3 3
    turn,  # A K 3
    half_size,  # A 3
    shown,  # A S
    enter,  # R A
    rays,
    boxes,
    times,
    segments,
    RAYS: tl.constexpr,
):
    r = tl.program_id(0).to(tl.int64) * RAYS + tl.arange(0, RAYS)
    inside = r < rays
    ox, oy, oz = _row_of(origin, r, inside)
    dx, dy, dz = _row_of(direction, r, inside)
    k = tl.load(segment + r, mask=inside, other=0)
    part = tl.load(share + r, mask=inside, other=0.0)
    # With a single key time both poses are the same
    step = tl.where(times > 1, 1, 0)
    for a in range(boxes):
        key = a * times + k
        x0, y0, z0 = _row_of(position, key, inside)
        x1, y1, z1 = _row_of(position, key + step, inside)
        # Origin of the ray relative to the box' centre, which moves linearly between key times
        px, py, pz = ox - x0 - part * (x1 - x0), oy - y0 - part * (y1 - y0), oz - z0 - part * (z1 - z0)
        # Into the axes of the box at the key time before
        qx, qy, qz = _into(rotation + 9 * key, px, py, pz)
        ex, ey, ez = _into(rotation + 9 * key, dx, dy, dz)
        tx, ty, tz = _row_of(turn, key, inside)
        # Then back by the rotation since: the sine is negative for the inverse
        angle = tl.sqrt(tx * tx + ty * ty + tz * tz)
        safe = tl.where(angle > 1e-12, angle, 1.0)
        c, s = tl.cos(part * angle), -tl.sin(part * angle)
        qx, qy, qz = _turned(qx, qy, qz, tx / safe, ty / safe, tz / safe, c, s)
        ex, ey, ez = _turned(ex, ey, ez, tx / safe, ty / safe, tz / safe, c, s)
        # Intersect the spans between the three pairs of sides
        near, far = tl.zeros([RAYS], tl.float32), tl.full([RAYS], float("inf"), tl.float32)
        near, far = _slab(qx, ex, tl.load(half_size + 3 * a), near, far)
        near, far = _slab(qy, ey, tl.load(half_size + 3 * a + 1), near, far)
        near, far = _slab(qz, ez, tl.load(half_size + 3 * a + 2), near, far)
        present = tl.load(shown + a * segments + k, mask=inside, other=0) != 0
        tl.store(
            enter + r * boxes + a,
            tl.where(present & (near < far), near, float("inf")),
            mask=inside,
        )
