"""Numba kernel of the random walk of Gaussians."""

from typing import no_type_check

import numpy as np

from foredrive.ops.vectors import ONE, ZERO, kernel

_TWO, _SMALL = np.float32(2), np.float32(1e-24)


@kernel
@no_type_check
def walk_rows(size, variance, quaternion, noise, place, way, first, last):
    """Compute the steps of Gaussians first … last - 1: size · R S² Rᵀ · noise.

    Args:
        size: Float[N]; 0 where a Gaussian stays.
        variance: Float[N 3], squared scales.
        quaternion: Float[N 4], w x y z, of any length.
        noise: Float[M 3].
        place: Int64[N], row of `noise` of each Gaussian that walks.
        way: Float[N 3], the result.
    """
    for i in range(first, last):
        if size[i] == ZERO:
            way[i, 0], way[i, 1], way[i, 2] = ZERO, ZERO, ZERO
            continue
        w, x, y, z = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
        twice = _TWO / max(w * w + x * x + y * y + z * z, _SMALL)
        # Rotation matrix of the quaternion, rows in the scene's axes
        xx, yy, zz = (
            ONE - twice * (y * y + z * z),
            ONE - twice * (x * x + z * z),
            ONE - twice * (x * x + y * y),
        )
        xy, yx = twice * (x * y - w * z), twice * (x * y + w * z)
        xz, zx = twice * (x * z + w * y), twice * (x * z - w * y)
        yz, zy = twice * (y * z - w * x), twice * (y * z + w * x)
        a, b, c = noise[place[i], 0], noise[place[i], 1], noise[place[i], 2]
        # Into the Gaussian's axes, where its shape is a product, and back
        along = size[i] * variance[i, 0] * (xx * a + yx * b + zx * c)
        across = size[i] * variance[i, 1] * (xy * a + yy * b + zy * c)
        up = size[i] * variance[i, 2] * (xz * a + yz * b + zz * c)
        way[i, 0] = xx * along + xy * across + xz * up
        way[i, 1] = yx * along + yy * across + yz * up
        way[i, 2] = zx * along + zy * across + zz * up
