"""Numba kernels with the gradients of `projection_kernels`. Names g_… are gradients of the loss.

A block's intermediate values are computed again: they fit into registers, and stored ones would not fit into
the caches.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.methods.splatad.projection_kernels import (
    LOG2_E,
    LOG_SCALE,
    MAX_EXPONENT,
    MEAN,
    MIN_RATIO,
    OPACITY_LOGIT,
    OTHER,
    QUATERNION,
    ROWS,
    SCANNED,
    SIX,
    THREE,
    TWO,
    VELOCITY,
    add_cross,
    cross,
    dot,
    find_scan_times,
    gather,
    in_sensor,
    moved,
    rotated,
)
from foredrive.ops.vectors import (
    HALF,
    ONE,
    ROW,
    ZERO,
    exp2_row,
    inlined_part,
    kernel,
    load_row,
    maximum,
    minimum,
    row_sum,
    select_greater,
    sqrt_row,
    store,
)

G_MEAN, G_INVERSE, G_OPACITY, G_RANGE, G_SLOPE, G_RATE, G_RANGE_RATE = 0, 2, 5, 6, 7, 9, 11
"""First row of each gradient of the result, behind the `ROWS` of a block."""
SUMS = 18
"""Number of sums over all Gaussians: gradients of the rotation, the position and the twist."""


class SplatGradients(NamedTuple):
    """Gradients with respect to the fields of `Splats` without features, float32 and contiguous."""

    mean: np.ndarray
    inverse_covariance: np.ndarray
    opacity: np.ndarray
    range_m: np.ndarray
    range_slope: np.ndarray
    velocity: np.ndarray
    range_rate_mps: np.ndarray


@inlined_part
@no_type_check
def _gather_gradients(block, count, gradients, rows):
    """Fill the rows behind those of a block with its gradients. Behind the last Gaussian they are 0."""
    for lane in range(ROW):
        i = min(block * ROW + lane, count - 1)
        here = ONE if block * ROW + lane < count else ZERO
        for k in range(2):
            rows[(ROWS + G_MEAN + k) * ROW + lane] = here * gradients.mean[i, k]
            rows[(ROWS + G_SLOPE + k) * ROW + lane] = here * gradients.range_slope[i, k]
            rows[(ROWS + G_RATE + k) * ROW + lane] = here * gradients.velocity[i, k]
        for k in range(3):
            rows[(ROWS + G_INVERSE + k) * ROW + lane] = here * gradients.inverse_covariance[i, k]
        rows[(ROWS + G_OPACITY) * ROW + lane] = here * gradients.opacity[i]
        rows[(ROWS + G_RANGE) * ROW + lane] = here * gradients.range_m[i]
        rows[(ROWS + G_RANGE_RATE) * ROW + lane] = here * gradients.range_rate_mps[i]


@inlined_part
@no_type_check
def _given(rows, which):
    return load_row(rows, (ROWS + which) * ROW)


@inlined_part
@no_type_check
def _shape(rows):
    """Return the rotation of a block's Gaussians row by row, and their standard deviations."""
    first = QUATERNION * ROW
    w, x, y, z = (
        load_row(rows, first),
        load_row(rows, first + ROW),
        load_row(rows, first + 2 * ROW),
        load_row(rows, first + 3 * ROW),
    )
    length = ONE / sqrt_row((w * w + x * x + y * y + z * z) * HALF)
    w, x, y, z = w * length, x * length, y * length, z * length
    first = LOG_SCALE * ROW
    a = exp2_row(minimum(load_row(rows, first) * LOG2_E, MAX_EXPONENT))
    b = exp2_row(minimum(load_row(rows, first + ROW) * LOG2_E, MAX_EXPONENT))
    c = exp2_row(minimum(load_row(rows, first + 2 * ROW) * LOG2_E, MAX_EXPONENT))
    xx, yy, zz = x * x, y * y, z * z
    rotation = (
        (ONE - yy - zz, x * y - w * z, x * z + w * y),
        (x * y + w * z, ONE - xx - zz, y * z - w * x),
        (x * z - w * y, y * z + w * x, ONE - xx - yy),
    )
    return rotation, (a, b, c), (w, x, y, z, length)


@inlined_part
@no_type_check
def _column(T, rotation, axis, size):
    """Return a column of M in the scene, and in the axes of the sensor."""
    here = (rotation[0][axis] * size, rotation[1][axis] * size, rotation[2][axis] * size)
    return here, rotated(T, here[0], here[1], here[2])


@inlined_part
@no_type_check
def _footprint_back(u, v, epsilon, compensate, opacity, rows):
    """Return the gradients of the rows U = (u; v) of the footprint, and that of the opacity without ε."""
    a, b, c = u
    d, e, f = v
    xx, xy, yy = dot(a, b, c, a, b, c), dot(a, b, c, d, e, f), dot(d, e, f, d, e, f)
    m0, m1, m2 = a * e - b * d, a * f - c * d, b * f - c * e
    area = dot(m0, m1, m2, m0, m1, m2)
    per = ONE / (area + (xx + yy) * epsilon + epsilon * epsilon)
    g0, g1, g2 = _given(rows, G_INVERSE), _given(rows, G_INVERSE + 1), _given(rows, G_INVERSE + 2)
    g_opacity = _given(rows, G_OPACITY)
    # Inverse = (yy + ε, -xy, xx + ε) / widened
    g_widened = (g1 * xy - g0 * (yy + epsilon) - g2 * (xx + epsilon)) * per * per
    g_xx, g_xy, g_yy = g2 * per, ZERO - g1 * per, g0 * per
    g_area = g_widened
    if compensate:
        # √(area / widened), which has no gradient at its lower bound
        ratio = area * per
        root = sqrt_row(maximum(ratio, MIN_RATIO))
        g_ratio = select_greater(ratio, MIN_RATIO, g_opacity * opacity * HALF / root, ZERO)
        g_area = g_area + g_ratio * per
        g_widened, g_area = g_widened - g_ratio * ratio * per, g_area - g_ratio * ratio * per
        g_opacity = g_opacity * root
    g_xx, g_yy = g_xx + g_widened * epsilon, g_yy + g_widened * epsilon
    n0, n1, n2 = m0 * g_area * TWO, m1 * g_area * TWO, m2 * g_area * TWO
    g_xx, g_yy = g_xx * TWO, g_yy * TWO
    g_u = (
        e * n0 + f * n1 + a * g_xx + d * g_xy,
        f * n2 - d * n0 + b * g_xx + e * g_xy,
        c * g_xx + f * g_xy - d * n1 - e * n2,
    )
    g_v = (
        d * g_yy + a * g_xy - b * n0 - c * n1,
        a * n0 - c * n2 + e * g_yy + b * g_xy,
        a * n1 + b * n2 + f * g_yy + c * g_xy,
    )
    return g_u, g_v, g_opacity


@inlined_part
@no_type_check
def _times(g, J, M):
    """Return the gradients of a row of J and of the columns of M for the products (J M) with gradients g."""
    g_J = (
        g[0] * M[0][0] + g[1] * M[1][0] + g[2] * M[2][0],
        g[0] * M[0][1] + g[1] * M[1][1] + g[2] * M[2][1],
        g[0] * M[0][2] + g[1] * M[1][2] + g[2] * M[2][2],
    )
    g_M = (
        (g[0] * J[0], g[0] * J[1], g[0] * J[2]),
        (g[1] * J[0], g[1] * J[1], g[1] * J[2]),
        (g[2] * J[0], g[2] * J[1], g[2] * J[2]),
    )
    return g_J, g_M


@inlined_part
@no_type_check
def _plus(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined_part
@no_type_check
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined_part
@no_type_check
def _scaled(a, factor):
    return a[0] * factor, a[1] * factor, a[2] * factor


@inlined_part
@no_type_check
def _back(T, x, y, z):
    """Return vectors of the sensor in the axes of the scene."""
    return x * T[0] + y * T[3] + z * T[6], x * T[1] + y * T[4] + z * T[7], x * T[2] + y * T[5] + z * T[8]


@inlined_part
@no_type_check
def _cross_rows(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined_part
@no_type_check
def _write(
    chosen,
    block,
    rows,
    sensor,
    shape,
    columns,
    position,
    g_opacity,
    opacity,
    g_M,
    g_p,
    g_v,
    g_twist,
    to,
    sums,
):
    """Write the gradients of a block's Gaussians, and its sums.

    Args:
        shape: result of `_shape`.
        columns: columns of M in the scene.
        position: positions in the sensor's frame.
        g_M, g_p, g_v: gradients of M by columns, of the position and of the relative velocity, in the axes
            of the sensor.
        g_twist: gradients of the twist so far.
        to: `GaussianArrays` of the gradients.
        sums: Float32[18], or empty: not needed.
    """
    T, turn = sensor.T_sensor_scene, sensor.twist[3:]
    _, sizes, quaternion = shape
    # v - u - ω × p
    g_p = _plus(g_p, cross(turn, g_v[0], g_v[1], g_v[2]))
    g_mean = _back(T, g_p[0], g_p[1], g_p[2])
    g_velocity = _back(T, g_v[0], g_v[1], g_v[2])
    g_a, g_b, g_c = (
        _back(T, g_M[0][0], g_M[0][1], g_M[0][2]),
        _back(T, g_M[1][0], g_M[1][1], g_M[1][2]),
        _back(T, g_M[2][0], g_M[2][1], g_M[2][2]),
    )
    # M = R S: by the standard deviations, then by their logarithms
    log_a = dot(g_a[0], g_a[1], g_a[2], columns[0][0], columns[0][1], columns[0][2])
    log_b = dot(g_b[0], g_b[1], g_b[2], columns[1][0], columns[1][1], columns[1][2])
    log_c = dot(g_c[0], g_c[1], g_c[2], columns[2][0], columns[2][1], columns[2][2])
    r0, r1, r2 = _scaled(g_a, sizes[0]), _scaled(g_b, sizes[1]), _scaled(g_c, sizes[2])
    w, x, y, z, length = quaternion
    # Gradients r0, r1, r2 of the columns of R; entries are products of the quaternion's components
    g_w = z * (r0[1] - r1[0]) + y * (r2[0] - r0[2]) + x * (r1[2] - r2[1])
    g_x = y * (r1[0] + r0[1]) + z * (r2[0] + r0[2]) + w * (r1[2] - r2[1]) - x * TWO * (r1[1] + r2[2])
    g_y = x * (r1[0] + r0[1]) + z * (r2[1] + r1[2]) + w * (r2[0] - r0[2]) - y * TWO * (r0[0] + r2[2])
    g_z = x * (r2[0] + r0[2]) + y * (r2[1] + r1[2]) + w * (r0[1] - r1[0]) - z * TWO * (r0[0] + r1[1])
    # The quaternion was normalised to √2: what is along it has no effect
    along = (w * g_w + x * g_x + y * g_y + z * g_z) * HALF
    g_logit = g_opacity * opacity * (ONE - opacity)
    if sums.size > 0:
        mean = (load_row(rows, 0), load_row(rows, ROW), load_row(rows, 2 * ROW))
        first = VELOCITY * ROW
        velocity = (load_row(rows, first), load_row(rows, first + ROW), load_row(rows, first + 2 * ROW))
        for i in range(3):
            sums[9 + i] = row_sum(g_p[i])
            for j in range(3):
                total = g_p[i] * mean[j] + g_v[i] * velocity[j] + g_M[0][i] * columns[0][j]
                sums[3 * i + j] = row_sum(total + g_M[1][i] * columns[1][j] + g_M[2][i] * columns[2][j])
        turned = _cross_rows(g_v, position)
        for i in range(3):
            sums[12 + i] = row_sum(g_twist[0][i] - g_v[i])
            sums[15 + i] = row_sum(g_twist[1][i] + turned[i])
    # By way of the block's memory to the Gaussians, each of which is in one block
    for k in range(3):
        store(rows, (MEAN + k) * ROW, g_mean[k])
        if to.velocity_mps.shape[0] > 0:  # otherwise these rows are the zeros of all blocks
            store(rows, (VELOCITY + k) * ROW, g_velocity[k])
    store(rows, LOG_SCALE * ROW, log_a)
    store(rows, (LOG_SCALE + 1) * ROW, log_b)
    store(rows, (LOG_SCALE + 2) * ROW, log_c)
    store(rows, QUATERNION * ROW, (g_w - w * along) * length)
    store(rows, (QUATERNION + 1) * ROW, (g_x - x * along) * length)
    store(rows, (QUATERNION + 2) * ROW, (g_y - y * along) * length)
    store(rows, (QUATERNION + 3) * ROW, (g_z - z * along) * length)
    store(rows, OPACITY_LOGIT * ROW, g_logit)
    for lane in range(min(ROW, chosen.size - block * ROW)):
        i = chosen[block * ROW + lane]
        for k in range(3):
            to.mean_m[i, k] = rows[(MEAN + k) * ROW + lane]
            to.log_scale[i, k] = rows[(LOG_SCALE + k) * ROW + lane]
        for k in range(4):
            to.quaternion[i, k] = rows[(QUATERNION + k) * ROW + lane]
        to.opacity_logit[i] = rows[OPACITY_LOGIT * ROW + lane]
        if to.velocity_mps.shape[0] > 0:
            for k in range(3):
                to.velocity_mps[i, k] = rows[(VELOCITY + k) * ROW + lane]


@inlined_part
@no_type_check
def _plain_opacity(rows):
    exponent = load_row(rows, OPACITY_LOGIT * ROW) * (ZERO - LOG2_E)
    return ONE / (exp2_row(minimum(exponent, MAX_EXPONENT)) + ONE)


@kernel
@no_type_check
def project_to_camera_backward(start, stop, chosen, gaussians, sensor, K, dist, limits, gradients, to, sums):
    """Write the gradients of `project_to_camera` for blocks start … stop - 1.

    Args:
        gradients: `SplatGradients`.
        to: `GaussianArrays` that get the gradients of the chosen Gaussians; others are not written.
        sums: Float32[blocks 18], the part of each block in the gradients of pose and twist, or [blocks 0].
    """
    rows, T = np.zeros((ROWS + 12) * ROW, np.float32), sensor.T_sensor_scene
    for block in range(start, stop):
        gather(chosen, block, gaussians, rows)
        _gather_gradients(block, chosen.size, gradients, rows)
        px, py, pz, vx, vy, vz = in_sensor(rows, sensor)
        shape = _shape(rows)
        rotation, sizes, _ = shape
        a, to_a = _column(T, rotation, 0, sizes[0])
        b, to_b = _column(T, rotation, 1, sizes[1])
        c, to_c = _column(T, rotation, 2, sizes[2])
        M = (to_a, to_b, to_c)
        near = ONE / pz
        x, y = px * near, py * near
        wx = minimum(maximum(x, limits[0]), limits[2])
        wy = minimum(maximum(y, limits[1]), limits[3])
        fx, fy, zero = K[0], K[1], pz * ZERO
        # Jacobian of the distortion, and its derivatives
        xx, xy, yy = zero + ONE, zero, zero + ONE
        xx_x, xx_y, xy_y, yy_y = zero, zero, zero, zero
        if dist.size > 0:
            k1, k2, p1, p2, k3 = dist[0], dist[1], dist[2], dist[3], dist[4]
            r2 = wx * wx + wy * wy
            radial = r2 * (r2 * (r2 * k3 + k2) + k1) + ONE
            slope = (r2 * (r2 * (THREE * k3) + TWO * k2) + k1) * TWO
            bend = (r2 * (SIX * k3) + TWO * k2) * TWO * TWO
            xx = radial + slope * wx * wx + wy * (TWO * p1) + wx * (SIX * p2)
            xy = slope * wx * wy + wx * (TWO * p1) + wy * (TWO * p2)
            yy = radial + slope * wy * wy + wy * (SIX * p1) + wx * (TWO * p2)
            xx_x = slope * wx * THREE + bend * wx * wx * wx + SIX * p2
            xx_y = slope * wy + bend * wx * wx * wy + TWO * p1
            xy_y = slope * wx + bend * wx * wy * wy + TWO * p2
            yy_y = slope * wy * THREE + bend * wy * wy * wy + SIX * p1
        across, down = xx * wx + xy * wy, xy * wx + yy * wy
        j = (xx * near * fx, xy * near * fx, across * near * (ZERO - fx))
        k = (xy * near * fy, yy * near * fy, down * near * (ZERO - fy))
        u = (
            dot(j[0], j[1], j[2], to_a[0], to_a[1], to_a[2]),
            dot(j[0], j[1], j[2], to_b[0], to_b[1], to_b[2]),
            dot(j[0], j[1], j[2], to_c[0], to_c[1], to_c[2]),
        )
        v = (
            dot(k[0], k[1], k[2], to_a[0], to_a[1], to_a[2]),
            dot(k[0], k[1], k[2], to_b[0], to_b[1], to_b[2]),
            dot(k[0], k[1], k[2], to_c[0], to_c[1], to_c[2]),
        )
        opacity = _plain_opacity(rows)
        g_u, g_v, g_opacity = _footprint_back(u, v, sensor.epsilon, sensor.compensate, opacity, rows)
        g_j, g_M = _times(g_u, j, M)
        g_k, more = _times(g_v, k, M)
        g_M = (_plus(g_M[0], more[0]), _plus(g_M[1], more[1]), _plus(g_M[2], more[2]))
        # Velocity on the image and along the axis
        rate_x, rate_y = _given(rows, G_RATE), _given(rows, G_RATE + 1)
        g_j = _plus(g_j, (vx * rate_x, vy * rate_x, vz * rate_x))
        g_k = _plus(g_k, (vx * rate_y, vy * rate_y, vz * rate_y))
        g_velocity = _plus(_scaled(j, rate_x), _scaled(k, rate_y))
        g_velocity = (g_velocity[0], g_velocity[1], g_velocity[2] + _given(rows, G_RANGE_RATE))
        # Jacobian: near · (xx, xy, -(xx wx + xy wy)) · fx, and likewise below
        g_j, g_k = _scaled(g_j, fx), _scaled(g_k, fy)
        g_near = g_j[0] * xx + g_j[1] * xy - g_j[2] * across + g_k[0] * xy + g_k[1] * yy - g_k[2] * down
        g_xx = (g_j[0] - g_j[2] * wx) * near
        g_xy = (g_j[1] - g_j[2] * wy + g_k[0] - g_k[2] * wx) * near
        g_yy = (g_k[1] - g_k[2] * wy) * near
        g_wx = ZERO - (g_j[2] * xx + g_k[2] * xy) * near + g_xx * xx_x + g_xy * xx_y + g_yy * xy_y
        g_wy = ZERO - (g_j[2] * xy + g_k[2] * yy) * near + g_xx * xx_y + g_xy * xy_y + g_yy * yy_y
        g_mean_x, g_mean_y = _given(rows, G_MEAN) * fx, _given(rows, G_MEAN + 1) * fy
        g_x, g_y = g_mean_x * xx + g_mean_y * xy, g_mean_x * xy + g_mean_y * yy
        if dist.size > 0:
            # Beyond the margin, the mean depends on the Jacobian at the margin, which a corner moves along
            dx, dy = x - wx, y - wy
            h_xx, h_xy, h_yy = g_mean_x * dx, g_mean_x * dy + g_mean_y * dx, g_mean_y * dy
            g_wx = g_wx + h_xx * xx_x + h_xy * xx_y + h_yy * xy_y
            g_wy = g_wy + h_xx * xx_y + h_xy * xy_y + h_yy * yy_y
        # Inside of the limits, the clamped place is the place
        g_x = g_x + select_greater(x, limits[0], select_greater(limits[2], x, g_wx, ZERO), ZERO)
        g_y = g_y + select_greater(y, limits[1], select_greater(limits[3], y, g_wy, ZERO), ZERO)
        g_near = g_near + g_x * px + g_y * py
        g_p = (g_x * near, g_y * near, _given(rows, G_RANGE) - g_near * near * near)
        nothing = (zero, zero, zero)
        _write(
            chosen, block, rows, sensor, shape, (a, b, c), (px, py, pz), g_opacity, opacity, g_M, g_p,
            g_velocity, (nothing, nothing), to, sums[block],
        )  # fmt: skip


@inlined_part
@no_type_check
def _angles_back(q, g_azimuth, g_elevation, g_range):
    """Return the gradient of positions for those of their angles and ranges."""
    x, y, z = q
    level2 = x * x + y * y
    level, range2 = sqrt_row(level2), level2 + z * z
    flat, up, out = g_azimuth / level2, g_elevation / (range2 * level), g_range / sqrt_row(range2)
    return x * out - y * flat - x * z * up, y * out + x * flat - y * z * up, z * out + level2 * up


@inlined_part
@no_type_check
def _jacobian_back(q, g_azimuth, g_elevation, g_range):
    """Return the gradient of positions for those of the three rows of the Jacobian."""
    x, y, z = q
    level2 = x * x + y * y
    level, range2 = sqrt_row(level2), level2 + z * z
    range_m = sqrt_row(range2)
    # Azimuth: (-y, x, 0) / level²
    per = ONE / level2
    value = (x * g_azimuth[1] - y * g_azimuth[0]) * per
    g_x = (g_azimuth[1] - x * value * TWO) * per
    g_y = ZERO - (g_azimuth[0] + y * value * TWO) * per
    # Elevation: (-x z, -y z, level²) / (level · range²)
    per = ONE / (level * range2)
    value = (level2 * g_elevation[2] - x * z * g_elevation[0] - y * z * g_elevation[1]) * per
    bottom = range2 / level + level * TWO
    g_x = g_x + (x * g_elevation[2] * TWO - z * g_elevation[0] - value * bottom * x) * per
    g_y = g_y + (y * g_elevation[2] * TWO - z * g_elevation[1] - value * bottom * y) * per
    g_z = (ZERO - x * g_elevation[0] - y * g_elevation[1] - value * level * z * TWO) * per
    # Range: (x, y, z) / range
    per = ONE / range_m
    value = dot(x, y, z, g_range[0], g_range[1], g_range[2]) * per * per
    g_x, g_y = g_x + (g_range[0] - x * value) * per, g_y + (g_range[1] - y * value) * per
    return g_x, g_y, g_z + (g_range[2] - z * value) * per


@inlined_part
@no_type_check
def _moved_back(p, v, twist, t, g_q, g_p, g_v, g_twist):
    """Add the gradients of positions at another time (`moved`) to those of position, velocity and twist."""
    linear, turn = twist[:3], twist[3:]
    tx, ty, tz = cross(turn, p[0], p[1], p[2])
    change = (v[0] * TWO + linear[0] + tx, v[1] * TWO + linear[1] + ty, v[2] * TWO + linear[2] + tz)
    # p + t v + t²/2 p'' with p'' = -ω × change
    g_a = _scaled(g_q, t * t * HALF)
    g_change = cross(turn, g_a[0], g_a[1], g_a[2])
    g_p = _minus(_plus(g_p, g_q), cross(turn, g_change[0], g_change[1], g_change[2]))
    g_v = _plus(_plus(g_v, _scaled(g_q, t)), _scaled(g_change, TWO))
    g_turn = _plus(_minus(g_twist[1], _cross_rows(change, g_a)), _cross_rows(p, g_change))
    return g_p, g_v, (_plus(g_twist[0], g_change), g_turn)


@kernel
@no_type_check
def project_to_lidar_backward(start, stop, chosen, gaussians, sensor, scan_s, turn_s, gradients, to, sums):
    """Write the gradients of `project_to_lidar`. The arguments are those of `project_to_camera_backward`."""
    rows, T = np.zeros((ROWS + 12) * ROW, np.float32), sensor.T_sensor_scene
    twist, turn = sensor.twist, sensor.twist[3:]
    for block in range(start, stop):
        gather(chosen, block, gaussians, rows)
        _gather_gradients(block, chosen.size, gradients, rows)
        x, y, z, vx, vy, vz = in_sensor(rows, sensor)
        p, velocity = (x, y, z), (vx, vy, vz)
        shape = _shape(rows)
        rotation, sizes, _ = shape
        a, to_a = _column(T, rotation, 0, sizes[0])
        b, to_b = _column(T, rotation, 1, sizes[1])
        c, to_c = _column(T, rotation, 2, sizes[2])
        M = (to_a, to_b, to_c)
        q, t, zero = p, x * ZERO, x * ZERO
        if scan_s.size > 0:
            find_scan_times(rows, x, y, z, vx, vy, vz, twist, scan_s, turn_s)
            t = load_row(rows, SCANNED * ROW)
            q = moved(x, y, z, vx, vy, vz, twist, t)
        qx, qy, qz = q
        level2 = qx * qx + qy * qy
        level, range2 = sqrt_row(level2), level2 + qz * qz
        flat, far2, far = ONE / level2, ONE / range2, ONE / sqrt_row(range2)
        across = far2 / level
        j = (ZERO - qy * flat, qx * flat, zero)
        k = (ZERO - qx * qz * across, ZERO - qy * qz * across, level * far2)
        m = (qx * far, qy * far, qz * far)
        j0, k0, m0 = j, k, m
        if scan_s.size > 0:
            j, k, m = add_cross(j, t, turn), add_cross(k, t, turn), add_cross(m, t, turn)
        u = (
            dot(j[0], j[1], j[2], to_a[0], to_a[1], to_a[2]),
            dot(j[0], j[1], j[2], to_b[0], to_b[1], to_b[2]),
            dot(j[0], j[1], j[2], to_c[0], to_c[1], to_c[2]),
        )
        v = (
            dot(k[0], k[1], k[2], to_a[0], to_a[1], to_a[2]),
            dot(k[0], k[1], k[2], to_b[0], to_b[1], to_b[2]),
            dot(k[0], k[1], k[2], to_c[0], to_c[1], to_c[2]),
        )
        w = (
            dot(m[0], m[1], m[2], to_a[0], to_a[1], to_a[2]),
            dot(m[0], m[1], m[2], to_b[0], to_b[1], to_b[2]),
            dot(m[0], m[1], m[2], to_c[0], to_c[1], to_c[2]),
        )
        # Slope of the range: inverse footprint times the covariance of the range with both angles
        xx, xy = dot(u[0], u[1], u[2], u[0], u[1], u[2]), dot(u[0], u[1], u[2], v[0], v[1], v[2])
        yy = dot(v[0], v[1], v[2], v[0], v[1], v[2])
        n0, n1, n2 = u[0] * v[1] - u[1] * v[0], u[0] * v[2] - u[2] * v[0], u[1] * v[2] - u[2] * v[1]
        epsilon = sensor.epsilon
        per = ONE / (dot(n0, n1, n2, n0, n1, n2) + (xx + yy) * epsilon + epsilon * epsilon)
        i0, i1, i2 = (yy + epsilon) * per, ZERO - xy * per, (xx + epsilon) * per
        s0, s1 = _given(rows, G_SLOPE), _given(rows, G_SLOPE + 1)
        with_u, with_v = dot(u[0], u[1], u[2], w[0], w[1], w[2]), dot(v[0], v[1], v[2], w[0], w[1], w[2])
        store(rows, (ROWS + G_INVERSE) * ROW, _given(rows, G_INVERSE) + s0 * with_u)
        store(rows, (ROWS + G_INVERSE + 1) * ROW, _given(rows, G_INVERSE + 1) + s0 * with_v + s1 * with_u)
        store(rows, (ROWS + G_INVERSE + 2) * ROW, _given(rows, G_INVERSE + 2) + s1 * with_v)
        g_with_u, g_with_v = s0 * i0 + s1 * i1, s0 * i1 + s1 * i2
        opacity = _plain_opacity(rows)
        g_u, g_v, g_opacity = _footprint_back(u, v, epsilon, sensor.compensate, opacity, rows)
        g_u, g_v = _plus(g_u, _scaled(w, g_with_u)), _plus(g_v, _scaled(w, g_with_v))
        g_w = _plus(_scaled(u, g_with_u), _scaled(v, g_with_v))
        g_j, g_M = _times(g_u, j, M)
        g_k, more = _times(g_v, k, M)
        g_M = (_plus(g_M[0], more[0]), _plus(g_M[1], more[1]), _plus(g_M[2], more[2]))
        g_m, more = _times(g_w, m, M)
        g_M = (_plus(g_M[0], more[0]), _plus(g_M[1], more[1]), _plus(g_M[2], more[2]))
        g_p, g_velocity = (zero, zero, zero), (zero, zero, zero)
        g_twist = ((zero, zero, zero), (zero, zero, zero))
        g0, g1, g2 = _given(rows, G_MEAN), _given(rows, G_MEAN + 1), _given(rows, G_RANGE)
        rate0, rate1, rate2 = _given(rows, G_RATE), _given(rows, G_RATE + 1), _given(rows, G_RANGE_RATE)
        if scan_s.size > 0:
            other = load_row(rows, OTHER * ROW)
            o = moved(x, y, z, vx, vy, vz, twist, other)
            # The line through both places at time 0: here - t · rate, rate = (beyond - here) / (other - t)
            per_s = ONE / (other - t)
            rate0, rate1, rate2 = (rate0 - t * g0) * per_s, (rate1 - t * g1) * per_s, (rate2 - t * g2) * per_s
            g_o = _angles_back(o, rate0, rate1, rate2)
            g_p, g_velocity, g_twist = _moved_back(p, velocity, twist, other, g_o, g_p, g_velocity, g_twist)
            g0, g1, g2 = g0 - rate0, g1 - rate1, g2 - rate2
            # J + t · ω × J
            turned = _plus(_plus(_cross_rows(j0, g_j), _cross_rows(k0, g_k)), _cross_rows(m0, g_m))
            g_twist = (g_twist[0], _plus(g_twist[1], _scaled(turned, t)))
            back = ZERO - t
            g_j, g_k, g_m = add_cross(g_j, back, turn), add_cross(g_k, back, turn), add_cross(g_m, back, turn)
        else:
            # The tangent at time 0: rates are J v
            g_j, g_k = _plus(g_j, _scaled(velocity, rate0)), _plus(g_k, _scaled(velocity, rate1))
            g_m = _plus(g_m, _scaled(velocity, rate2))
            g_velocity = _plus(_plus(_scaled(j, rate0), _scaled(k, rate1)), _scaled(m, rate2))
        g_q = _plus(_angles_back(q, g0, g1, g2), _jacobian_back(q, g_j, g_k, g_m))
        if scan_s.size > 0:
            g_p, g_velocity, g_twist = _moved_back(p, velocity, twist, t, g_q, g_p, g_velocity, g_twist)
        else:
            g_p = g_q
        _write(
            chosen, block, rows, sensor, shape, (a, b, c), p, g_opacity, opacity, g_M, g_p, g_velocity,
            g_twist, to, sums[block],
        )  # fmt: skip
