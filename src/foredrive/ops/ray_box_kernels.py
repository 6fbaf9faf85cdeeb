"""Numba kernel of `cross_boxes`: the moving boxes that each ray passes through."""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.vectors import ONE, ZERO, inlined_part, kernel

_SMALL = np.float32(1e-12)


class RayBoxInputs(NamedTuple):
    """Inputs of the kernel."""

    origin: np.ndarray
    """Float[R 3], in the scene's frame."""
    direction: np.ndarray
    """Float[R 3], unit vectors."""
    segment: np.ndarray
    """Int32[R], key time before the ray's time."""
    share: np.ndarray
    """Float[R], part of the segment that has passed at the ray's time."""
    position: np.ndarray
    """Float[A K 3], of the boxes' centres."""
    rotation: np.ndarray
    """Float[A K 3 3], from the boxes' frames."""
    turn: np.ndarray
    """Float[A K 3], rotation vector until the next key time, in the box's axes; 0 at the last."""
    half_size: np.ndarray
    """Float[A 3]."""
    present: np.ndarray
    """Bool[A S], whether the box is there in a segment of time."""
    steps: int
    """1, or 0 if there is a single key time."""


@kernel
@no_type_check
def cross_rays(inputs, first, last, counts, starts, ray, box, span):
    """Count the boxes that rays first … last - 1 cross, or write them.

    If `ray` is empty, write the number of crossings to `counts`. Otherwise write ray, box, and the distances
    of entry and exit (`span` [P 2]) from starts[ray] on, in order of entry.
    """
    write = ray.size > 0
    # Origin of the ray relative to the box' centre at the ray's time
    for r in range(first, last):
        ox, oy, oz = inputs.origin[r, 0], inputs.origin[r, 1], inputs.origin[r, 2]
        dx, dy, dz = inputs.direction[r, 0], inputs.direction[r, 1], inputs.direction[r, 2]
        k, share, count = inputs.segment[r], inputs.share[r], 0
        for a in range(inputs.position.shape[0]):
            if not inputs.present[a, k]:
                continue
            px, py, pz = _between(inputs.position, a, k, share, inputs.steps)
            px, py, pz = ox - px, oy - py, oz - pz
            hx, hy, hz = inputs.half_size[a, 0], inputs.half_size[a, 1], inputs.half_size[a, 2]
            # Bounding sphere first: compare the squared distance of the centre from the ray's line
            along = px * dx + py * dy + pz * dz
            apart = px * px + py * py + pz * pz - along * along
            if apart > np.float32(1.0001) * (hx * hx + hy * hy + hz * hz):
                continue
            # In the axes of the box at key time k, then turned back by its rotation since.
            qx, qy, qz = _into(inputs.rotation, a, k, px, py, pz)
            ex, ey, ez = _into(inputs.rotation, a, k, dx, dy, dz)
            tx, ty, tz = inputs.turn[a, k, 0], inputs.turn[a, k, 1], inputs.turn[a, k, 2]
            qx, qy, qz = _turned(qx, qy, qz, tx, ty, tz, -share)
            ex, ey, ez = _turned(ex, ey, ez, tx, ty, tz, -share)
            # Intersect the spans between the three pairs of sides; the ray starts at distance 0
            near, far = np.float32(0), np.float32(np.inf)
            near, far = _slab(qx, ex, hx, near, far)
            near, far = _slab(qy, ey, hy, near, far)
            near, far = _slab(qz, ez, hz, near, far)
            if near < far:
                if write:
                    # Insertion sort by distance of entry: a ray crosses few boxes
                    slot = starts[r] + count
                    while slot > starts[r] and span[slot - 1, 0] > near:
                        box[slot], span[slot, 0], span[slot, 1] = (
                            box[slot - 1],
                            span[slot - 1, 0],
                            span[slot - 1, 1],
                        )
                        slot -= 1
                    box[slot], span[slot, 0], span[slot, 1] = a, near, far
                    ray[starts[r] + count] = r
                count += 1
        if not write:
            counts[r] = count


@inlined_part
@no_type_check
def _between(position, a, k, share, steps):
    x0, y0, z0 = position[a, k, 0], position[a, k, 1], position[a, k, 2]
    # `steps` is 0 for a single key time, so that both poses are the same
    n = k + steps
    x1, y1, z1 = position[a, n, 0], position[a, n, 1], position[a, n, 2]
    return x0 + share * (x1 - x0), y0 + share * (y1 - y0), z0 + share * (z1 - z0)


@inlined_part
@no_type_check
def _into(rotation, a, k, x, y, z):
    """Return Rᵀ v."""
    return (
        rotation[a, k, 0, 0] * x + rotation[a, k, 1, 0] * y + rotation[a, k, 2, 0] * z,
        rotation[a, k, 0, 1] * x + rotation[a, k, 1, 1] * y + rotation[a, k, 2, 1] * z,
        rotation[a, k, 0, 2] * x + rotation[a, k, 1, 2] * y + rotation[a, k, 2, 2] * z,
    )


@inlined_part
@no_type_check
def _turned(x, y, z, tx, ty, tz, share):
    """Rotate a vector by share · t about t (Rodrigues)."""
    square = tx * tx + ty * ty + tz * tz
    # Small angles: first order, because the axis is not defined at 0
    if square < _SMALL:
        return x + share * (ty * z - tz * y), y + share * (tz * x - tx * z), z + share * (tx * y - ty * x)
    angle = np.sqrt(square)
    ux, uy, uz = tx / angle, ty / angle, tz / angle
    c, s = np.cos(share * angle), np.sin(share * angle)
    # Rodrigues: v cos θ + (u × v) sin θ + u (u · v) (1 - cos θ)
    along = (ux * x + uy * y + uz * z) * (ONE - c)
    return (
        c * x + s * (uy * z - uz * y) + along * ux,
        c * y + s * (uz * x - ux * z) + along * uy,
        c * z + s * (ux * y - uy * x) + along * uz,
    )


@inlined_part
@no_type_check
def _slab(q, e, half, near, far):
    """Shorten a span of a ray to the part between two planes at ±half."""
    # A ray parallel to the planes is between them everywhere or nowhere (an empty span)
    if e == ZERO:
        return (near, far) if np.abs(q) <= half else (ONE, ZERO)
    # Distances of the two planes; which is first depends on the direction's sign
    a, b = (-half - q) / e, (half - q) / e
    return max(near, min(a, b)), min(far, max(a, b))
