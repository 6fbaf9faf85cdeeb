"""Numba kernels that project Gaussians to the image of a camera, and their gradients."""

from typing import no_type_check

import numpy as np

from foredrive.methods.splatad.gaussian_kernels import (
    ALL_ROWS,
    CENTRE,
    INVERSE,
    OPACITY,
    RANGE,
    RANGE_RATE,
    RATE,
    SIX,
    THREE,
    TWO,
    compensation,
    cross,
    dot,
    factor_columns,
    footprint,
    footprint_back,
    gather,
    gather_gradients,
    gradient,
    in_axes,
    in_sensor,
    opacity,
    plus,
    plus_columns,
    put_splats,
    rotated_back,
    scaled,
    scatter,
    shape,
    store_gradients,
    sum_gradients,
    through,
    through_back,
)
from foredrive.ops.vectors import ONE, ROW, ZERO, inlined_part, kernel, maximum, minimum, select_greater


@inlined_part
@no_type_check
def _within(x, y, limits):
    """Return places clamped to the image with its margin, where the Jacobian is taken."""
    return minimum(maximum(x, limits[0]), limits[2]), minimum(maximum(y, limits[1]), limits[3])


@inlined_part
@no_type_check
def _bent(x, y, dist):
    """Return the radial factor of the distortion at a place, half its slope, and its Jacobian xx, xy, yy."""
    k1, k2, p1, p2, k3 = dist[0], dist[1], dist[2], dist[3], dist[4]
    r2 = x * x + y * y
    radial = r2 * (r2 * (r2 * k3 + k2) + k1) + ONE
    slope = (r2 * (r2 * (THREE * k3) + TWO * k2) + k1) * TWO
    xx = radial + slope * x * x + y * (TWO * p1) + x * (SIX * p2)
    xy = slope * x * y + x * (TWO * p1) + y * (TWO * p2)
    yy = radial + slope * y * y + y * (SIX * p1) + x * (TWO * p2)
    return radial, slope, (xx, xy, yy)


@inlined_part
@no_type_check
def _jacobian(bend, x, y, near, fx, fy):
    """Return the Jacobian of pixels by positions: that of the distortion times that of (x/z, y/z)."""
    xx, xy, yy = bend
    across, down = xx * x + xy * y, xy * x + yy * y
    return (
        (xx * near * fx, xy * near * fx, across * near * (ZERO - fx)),
        (xy * near * fy, yy * near * fy, down * near * (ZERO - fy)),
    )


@kernel
@no_type_check
def project_to_camera(start, stop, chosen, gaussians, sensor, K, dist, limits, out):
    """Fill blocks start … stop - 1 of `out`, Float32[12 M], with the chosen Gaussians.

    Args:
        chosen: Int32[M].
        K: Float32[4], focal lengths and principal point.
        dist: Float32[5], or Float32[0] without distortion.
        limits: Float32[4], lower and upper bounds of x/z and y/z.
    """
    rows, fx, fy = np.zeros(ALL_ROWS * ROW, np.float32), K[0], K[1]
    for block in range(start, stop):
        gather(chosen, block, gaussians, rows)
        p, v = in_sensor(rows, sensor)
        near, zero = ONE / p[2], p[2] * ZERO
        x, y = p[0] * near, p[1] * near
        wx, wy = _within(x, y, limits)
        bend = (zero + ONE, zero, zero + ONE)
        if dist.size > 0:
            radial, _, bend = _bent(wx, wy, dist)
            p1, p2, r2 = dist[2], dist[3], wx * wx + wy * wy
            # Beyond the margin, the distortion is continued linearly
            dx, dy = x - wx, y - wy
            x = wx * radial + wx * wy * (TWO * p1) + (r2 + wx * wx * TWO) * p2 + bend[0] * dx + bend[1] * dy
            y = wy * radial + (r2 + wy * wy * TWO) * p1 + wx * wy * (TWO * p2) + bend[1] * dx + bend[2] * dy
        j, k = _jacobian(bend, wx, wy, near, fx, fy)
        columns, sizes, _ = shape(rows)
        M = in_axes(sensor.T_sensor_scene, factor_columns(columns, sizes))
        inverse, ratio = footprint(through(j, M), through(k, M), sensor.epsilon)
        alpha = opacity(rows)
        if sensor.compensate:
            alpha = alpha * compensation(ratio)
        centre, rate = (x * fx + K[2], y * fy + K[3]), (dot(j, v), dot(k, v))
        put_splats(out, block, rows, centre, inverse, alpha, p[2], (zero, zero), rate, v[2])


@inlined_part
@no_type_check
def _bend_back(x, y, slope, dist, g):
    """Return the gradient of a place for those of the Jacobian xx, xy, yy of the distortion there."""
    k2, p1, p2, k3 = dist[1], dist[2], dist[3], dist[4]
    curve = ((x * x + y * y) * (SIX * k3) + TWO * k2) * (TWO * TWO)
    xx_x = slope * x * THREE + curve * x * x * x + SIX * p2
    # The second derivatives are symmetric: xx by y is xy by x, and yy by x is xy by y
    xx_y = slope * y + curve * x * x * y + TWO * p1
    xy_y = slope * x + curve * x * y * y + TWO * p2
    yy_y = slope * y * THREE + curve * y * y * y + SIX * p1
    return g[0] * xx_x + g[1] * xx_y + g[2] * xy_y, g[0] * xx_y + g[1] * xy_y + g[2] * yy_y


@inlined_part
@no_type_check
def _position_back(p, near, limits, dist, fx, fy, g_centre, g_j, g_k):
    """Return the gradient of positions for those of pixels and of the rows of the Jacobian."""
    zero = near * ZERO
    x, y = p[0] * near, p[1] * near
    wx, wy = _within(x, y, limits)
    slope, bend = zero, (zero + ONE, zero, zero + ONE)
    if dist.size > 0:
        _, slope, bend = _bent(wx, wy, dist)
    xx, xy, yy = bend
    # Jacobian: near · (xx, xy, -(xx wx + xy wy)) · fx, and likewise below
    j, k = scaled(g_j, fx), scaled(g_k, fy)
    g_near = j[0] * xx + j[1] * xy - j[2] * (xx * wx + xy * wy)
    g_near = g_near + k[0] * xy + k[1] * yy - k[2] * (xy * wx + yy * wy)
    g_wx, g_wy = ZERO - (j[2] * xx + k[2] * xy) * near, ZERO - (j[2] * xy + k[2] * yy) * near
    g_u, g_v = g_centre[0] * fx, g_centre[1] * fy
    if dist.size > 0:
        # Beyond the margin, the pixel depends on the Jacobian at the margin too
        dx, dy = x - wx, y - wy
        g_xx = (j[0] - j[2] * wx) * near + g_u * dx
        g_xy = (j[1] - j[2] * wy + k[0] - k[2] * wx) * near + g_u * dy + g_v * dx
        g_yy = (k[1] - k[2] * wy) * near + g_v * dy
        more_x, more_y = _bend_back(wx, wy, slope, dist, (g_xx, g_xy, g_yy))
        g_wx, g_wy = g_wx + more_x, g_wy + more_y
    # Inside of the limits, the clamped place is the place
    g_x = g_u * xx + g_v * xy
    g_y = g_u * xy + g_v * yy
    g_x = g_x + select_greater(x, limits[0], select_greater(limits[2], x, g_wx, ZERO), ZERO)
    g_y = g_y + select_greater(y, limits[1], select_greater(limits[3], y, g_wy, ZERO), ZERO)
    g_near = g_near + g_x * p[0] + g_y * p[1]
    return g_x * near, g_y * near, ZERO - g_near * near * near


@kernel
@no_type_check
def project_to_camera_backward(start, stop, chosen, gaussians, sensor, K, dist, limits, gradients, to, sums):
    """Write the gradients of `project_to_camera` for blocks start … stop - 1.

    Args:
        gradients: `SplatGradients`.
        to: `GaussianArrays` that get the gradients of the chosen Gaussians; others are not written.
        sums: Float32[blocks 18], the part of each block in the gradients of pose and twist, or [blocks 0].
    """
    rows, fx, fy = np.zeros(ALL_ROWS * ROW, np.float32), K[0], K[1]
    for block in range(start, stop):
        gather(chosen, block, gaussians, rows)
        gather_gradients(block, chosen.size, gradients, rows)
        p, v = in_sensor(rows, sensor)
        near, zero = ONE / p[2], p[2] * ZERO
        wx, wy = _within(p[0] * near, p[1] * near, limits)
        bend = (zero + ONE, zero, zero + ONE)
        if dist.size > 0:
            _, _, bend = _bent(wx, wy, dist)
        j, k = _jacobian(bend, wx, wy, near, fx, fy)
        shapes = shape(rows)
        M_scene = factor_columns(shapes[0], shapes[1])
        M = in_axes(sensor.T_sensor_scene, M_scene)
        # Footprint, then J M
        g_inverse = (gradient(rows, INVERSE), gradient(rows, INVERSE + 1), gradient(rows, INVERSE + 2))
        plain = opacity(rows)
        g_u, g_w, g_alpha = footprint_back(
            through(j, M), through(k, M), sensor, plain, g_inverse, gradient(rows, OPACITY)
        )
        g_j, g_M = through_back(g_u, j, M)
        g_k, more = through_back(g_w, k, M)
        g_M = plus_columns(g_M, more)
        # Velocity on the image and along the axis: J v
        rate_x, rate_y = gradient(rows, RATE), gradient(rows, RATE + 1)
        g_j, g_k = plus(g_j, scaled(v, rate_x)), plus(g_k, scaled(v, rate_y))
        g_v = plus(scaled(j, rate_x), scaled(k, rate_y))
        g_v = (g_v[0], g_v[1], g_v[2] + gradient(rows, RANGE_RATE))
        g_centre = (gradient(rows, CENTRE), gradient(rows, CENTRE + 1))
        g_p = _position_back(p, near, limits, dist, fx, fy, g_centre, g_j, g_k)
        g_p = plus((g_p[0], g_p[1], g_p[2] + gradient(rows, RANGE)), cross(sensor.twist[3:], g_v))
        if sums.shape[1] > 0:
            nothing = (zero, zero, zero)
            sum_gradients(rows, M_scene, p, g_M, g_p, g_v, (nothing, nothing), sums[block])
        store_gradients(rows, sensor, shapes, M_scene, plain, g_alpha, g_M, g_p, g_v)
        scatter(chosen, block, rows, rotated_back(sensor.T_sensor_scene, g_v), to)
