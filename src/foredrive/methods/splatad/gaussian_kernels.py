"""Parts of the numba kernels that project Gaussians: what cameras and lidars have in common.

`camera_kernels` and `lidar_kernels` compute what `camera` and `lidar` compute in PyTorch, sixteen Gaussians
(a block) at a time, with all intermediate values in registers. Results differ by rounding. For the gradients,
the intermediate values are computed again. Names g_… are gradients of the loss; vectors are tuples of rows.
`projection_numba` has the tuples of arrays that they take.
"""

import math
from typing import no_type_check

import numpy as np

from foredrive.ops.vectors import (
    HALF,
    ONE,
    ROW,
    ZERO,
    exp2_row,
    inlined_part,
    load_row,
    maximum,
    minimum,
    row_sum,
    select_greater,
    sqrt_row,
    store,
)

LOG2_E = np.float32(math.log2(math.e))
TWO, THREE, SIX = np.float32(2), np.float32(3), np.float32(6)
MIN_RATIO = np.float32(1e-12)
"""As `footprint.MIN_RATIO`."""
MAX_EXPONENT, LOWEST = np.float32(126), np.float32(-3e38)

# Rows of a block's memory: Gaussians, scan times (see `lidar_kernels`), then the gradients of the result.
MEAN, QUATERNION, LOG_SCALE, OPACITY_LOGIT, VELOCITY, TIMES = 0, 3, 7, 10, 11, 14
GRADIENTS, ALL_ROWS = 16, 28
# Rows of the result, and of its gradients.
CENTRE, INVERSE, OPACITY, RANGE, SLOPE, RATE, RANGE_RATE, OUTPUTS = 0, 2, 5, 6, 7, 9, 11, 12
SUMS = 18
"""Number of sums over all Gaussians: gradients of the rotation, the position and the twist."""


@inlined_part
@no_type_check
def gather(chosen, block, gaussians, rows):
    """Fill the rows of a block with its Gaussians. Behind the last one, it is repeated."""
    last = chosen.size - 1
    for lane in range(ROW):
        i = chosen[min(block * ROW + lane, last)]
        for k in range(3):
            rows[(MEAN + k) * ROW + lane] = gaussians.mean_m[i, k]
            rows[(LOG_SCALE + k) * ROW + lane] = gaussians.log_scale[i, k]
        for k in range(4):
            rows[(QUATERNION + k) * ROW + lane] = gaussians.quaternion[i, k]
        rows[OPACITY_LOGIT * ROW + lane] = gaussians.opacity_logit[i]
        if gaussians.velocity_mps.shape[0] > 0:
            for k in range(3):
                rows[(VELOCITY + k) * ROW + lane] = gaussians.velocity_mps[i, k]


@inlined_part
@no_type_check
def gather_gradients(block, count, gradients, rows):
    """Fill the rows of a block with the gradients of its result. Behind the last Gaussian they are 0."""
    for lane in range(ROW):
        i = min(block * ROW + lane, count - 1)
        counts = ONE if block * ROW + lane < count else ZERO
        for k in range(2):
            rows[(GRADIENTS + CENTRE + k) * ROW + lane] = counts * gradients.mean[i, k]
            rows[(GRADIENTS + SLOPE + k) * ROW + lane] = counts * gradients.range_slope[i, k]
            rows[(GRADIENTS + RATE + k) * ROW + lane] = counts * gradients.velocity[i, k]
        for k in range(3):
            rows[(GRADIENTS + INVERSE + k) * ROW + lane] = counts * gradients.inverse_covariance[i, k]
        rows[(GRADIENTS + OPACITY) * ROW + lane] = counts * gradients.opacity[i]
        rows[(GRADIENTS + RANGE) * ROW + lane] = counts * gradients.range_m[i]
        rows[(GRADIENTS + RANGE_RATE) * ROW + lane] = counts * gradients.range_rate_mps[i]


@inlined_part
@no_type_check
def load3(rows, first):
    """Return three rows as a vector."""
    return load_row(rows, first * ROW), load_row(rows, (first + 1) * ROW), load_row(rows, (first + 2) * ROW)


@inlined_part
@no_type_check
def gradient(rows, which):
    """Return the gradient of a row of the result."""
    return load_row(rows, (GRADIENTS + which) * ROW)


@inlined_part
@no_type_check
def dot(a, b):
    """Return the dot product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined_part
@no_type_check
def plus(a, b):
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined_part
@no_type_check
def minus(a, b):
    """Return the difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined_part
@no_type_check
def scaled(a, factor):
    """Return a vector times a row."""
    return a[0] * factor, a[1] * factor, a[2] * factor


@inlined_part
@no_type_check
def cross(a, b):
    """Return the cross product of two vectors, of which the first may be an array of three numbers."""
    return b[2] * a[1] - b[1] * a[2], b[0] * a[2] - b[2] * a[0], b[1] * a[0] - b[0] * a[1]


@inlined_part
@no_type_check
def rotated(T, a):
    """Return a vector of the scene in the axes of the sensor."""
    x, y, z = a
    return x * T[0] + y * T[1] + z * T[2], x * T[3] + y * T[4] + z * T[5], x * T[6] + y * T[7] + z * T[8]


@inlined_part
@no_type_check
def rotated_back(T, a):
    """Return a vector of the sensor in the axes of the scene."""
    x, y, z = a
    return x * T[0] + y * T[3] + z * T[6], x * T[1] + y * T[4] + z * T[7], x * T[2] + y * T[5] + z * T[8]


@inlined_part
@no_type_check
def in_sensor(rows, sensor):
    """Return the positions of a block's Gaussians, and their velocities relative to the moving sensor."""
    T, linear, turn = sensor.T_sensor_scene, sensor.twist[:3], sensor.twist[3:]
    x, y, z = rotated(T, load3(rows, MEAN))
    p = x + T[9], y + T[10], z + T[11]
    vx, vy, vz = rotated(T, load3(rows, VELOCITY))
    # v - v_sensor - ω × p
    return p, minus((vx - linear[0], vy - linear[1], vz - linear[2]), cross(turn, p))


@inlined_part
@no_type_check
def exp_row(x):
    """Return e^x. Unlike with `exp2_row`, NaN stays NaN, so that what has diverged is noticed."""
    power = exp2_row(minimum(x * LOG2_E, MAX_EXPONENT))
    # Comparisons with NaN are false; adding x - x would do, but may be simplified to nothing
    return select_greater(x, LOWEST, power, select_greater(ZERO, x, ZERO, x))


@inlined_part
@no_type_check
def shape(rows):
    """Return the shapes of a block's Gaussians: rotations R by columns, deviations S, unit quaternions.

    Quaternions have the length √2, so that products are twice those of length 1. With them comes the factor
    to this length.
    """
    first = QUATERNION * ROW
    w = load_row(rows, first)
    x, y, z = load3(rows, QUATERNION + 1)
    factor = ONE / sqrt_row((w * w + x * x + y * y + z * z) * HALF)
    w, x, y, z = w * factor, x * factor, y * factor, z * factor
    xx, yy, zz = x * x, y * y, z * z
    columns = (
        (ONE - yy - zz, x * y + w * z, x * z - w * y),
        (x * y - w * z, ONE - xx - zz, y * z + w * x),
        (x * z + w * y, y * z - w * x, ONE - xx - yy),
    )
    a, b, c = load3(rows, LOG_SCALE)
    return columns, (exp_row(a), exp_row(b), exp_row(c)), (w, x, y, z, factor)


@inlined_part
@no_type_check
def factor_columns(columns, sizes):
    """Return M = R S of the covariance M Mᵀ by columns, in the scene."""
    return scaled(columns[0], sizes[0]), scaled(columns[1], sizes[1]), scaled(columns[2], sizes[2])


@inlined_part
@no_type_check
def in_axes(T, M):
    """Return M in the axes of the sensor."""
    return rotated(T, M[0]), rotated(T, M[1]), rotated(T, M[2])


@inlined_part
@no_type_check
def through(J, M):
    """Return a row J of a Jacobian times M."""
    return dot(J, M[0]), dot(J, M[1]), dot(J, M[2])


@inlined_part
@no_type_check
def through_back(g, J, M):
    """Return the gradients of J and of the columns of M for the gradients g of `through`."""
    g_J = plus(plus(scaled(M[0], g[0]), scaled(M[1], g[1])), scaled(M[2], g[2]))
    return g_J, (scaled(J, g[0]), scaled(J, g[1]), scaled(J, g[2]))


@inlined_part
@no_type_check
def plus_columns(a, b):
    """Return the sum of two matrices by columns."""
    return plus(a[0], b[0]), plus(a[1], b[1]), plus(a[2], b[2])


@inlined_part
@no_type_check
def footprint(u, v, epsilon):
    """Return the inverse of U Uᵀ + ε for rows U = (u; v), and the share of the area that is not due to ε."""
    xx, xy, yy = dot(u, u), dot(u, v), dot(v, v)
    # Cauchy-Binet: det U Uᵀ is the sum of the squared minors, without cancellation
    minors = cross(u, v)
    area = dot(minors, minors)
    per = ONE / (area + (xx + yy) * epsilon + epsilon * epsilon)
    return ((yy + epsilon) * per, ZERO - xy * per, (xx + epsilon) * per), area * per


@inlined_part
@no_type_check
def opacity(rows):
    """Return the opacities of a block's Gaussians."""
    return ONE / (exp_row(ZERO - load_row(rows, OPACITY_LOGIT * ROW)) + ONE)


@inlined_part
@no_type_check
def compensation(ratio):
    """Return the factor of the opacity for the share of the area that is not due to ε."""
    return sqrt_row(maximum(ratio, MIN_RATIO))


@inlined_part
@no_type_check
def put(out, column, block, rows, value):
    """Write a row of the result. The last block of an array may be shorter."""
    count, begin = out.shape[1], block * ROW
    if begin + ROW <= count:
        store(out, column * count + begin, value)
    else:
        # By way of the block's memory: what lies behind the end is dropped
        store(rows, 0, value)
        for lane in range(count - begin):
            out[column, begin + lane] = rows[lane]


@inlined_part
@no_type_check
def put_splats(out, block, rows, centre, inverse, alpha, range_m, slope, rate, range_rate):
    """Write the splats of a block. All rows that are read must have been read before."""
    for k in range(2):
        put(out, CENTRE + k, block, rows, centre[k])
        put(out, SLOPE + k, block, rows, slope[k])
        put(out, RATE + k, block, rows, rate[k])
    for k in range(3):
        put(out, INVERSE + k, block, rows, inverse[k])
    put(out, OPACITY, block, rows, alpha)
    put(out, RANGE, block, rows, range_m)
    put(out, RANGE_RATE, block, rows, range_rate)


@inlined_part
@no_type_check
def footprint_back(u, v, sensor, plain, g, g_alpha):
    """Return the gradients of U = (u; v) and of the opacity without compensation.

    Args:
        u, v: rows of U.
        sensor: `SensorArrays`.
        plain: opacity without compensation.
        g: gradients of the inverse.
        g_alpha: gradient of the opacity.
    """
    epsilon = sensor.epsilon
    xx, xy, yy = dot(u, u), dot(u, v), dot(v, v)
    minors = cross(u, v)
    area = dot(minors, minors)
    per = ONE / (area + (xx + yy) * epsilon + epsilon * epsilon)
    # Inverse = (yy + ε, -xy, xx + ε) / widened
    g_widened = (g[1] * xy - g[0] * (yy + epsilon) - g[2] * (xx + epsilon)) * per * per
    g_xx, g_xy, g_yy = g[2] * per, ZERO - g[1] * per, g[0] * per
    g_area = g_widened
    if sensor.compensate:
        # √(area / widened), which has no gradient at its lower bound
        ratio = area * per
        root = compensation(ratio)
        g_ratio = select_greater(ratio, MIN_RATIO, g_alpha * plain * HALF / root, ZERO)
        g_widened = g_widened - g_ratio * ratio * per
        g_area = g_area + g_ratio * per - g_ratio * ratio * per
        g_alpha = g_alpha * root
    # widened = area + ε (xx + yy) + ε², area = |u × v|²
    g_xx, g_yy = (g_xx + g_widened * epsilon) * TWO, (g_yy + g_widened * epsilon) * TWO
    g_minors = scaled(minors, g_area * TWO)
    g_u = plus(plus(scaled(u, g_xx), scaled(v, g_xy)), cross(v, g_minors))
    g_v = plus(plus(scaled(v, g_yy), scaled(u, g_xy)), cross(g_minors, u))
    return g_u, g_v, g_alpha


@inlined_part
@no_type_check
def sum_gradients(rows, M, position, g_M, g_p, g_v, g_twist, sums):
    """Write the sums of a block: gradients of the rotation, the position and the twist of the sensor."""
    mean, velocity = load3(rows, MEAN), load3(rows, VELOCITY)
    # Vectors in the sensor's axes are the rotation times those of the scene
    for i in range(3):
        sums[9 + i] = row_sum(g_p[i])
        for j in range(3):
            total = g_p[i] * mean[j] + g_v[i] * velocity[j] + g_M[0][i] * M[0][j]
            sums[3 * i + j] = row_sum(total + g_M[1][i] * M[1][j] + g_M[2][i] * M[2][j])
    # v - u - ω × p
    turned = cross(g_v, position)
    for i in range(3):
        sums[12 + i] = row_sum(g_twist[0][i] - g_v[i])
        sums[15 + i] = row_sum(g_twist[1][i] + turned[i])


@inlined_part
@no_type_check
def store_gradients(rows, sensor, shapes, M, plain, g_alpha, g_M, g_p, g_v):
    """Store the gradients of a block's Gaussians in the rows from which their values came."""
    T = sensor.T_sensor_scene
    _, sizes, quaternion = shapes
    a, b, c = rotated_back(T, g_M[0]), rotated_back(T, g_M[1]), rotated_back(T, g_M[2])
    mean = rotated_back(T, g_p)
    # M = R S: by the logarithms of the standard deviations
    log_scale = dot(a, M[0]), dot(b, M[1]), dot(c, M[2])
    # Gradients of the columns of R, whose entries are products of the quaternion's components
    r0, r1, r2 = scaled(a, sizes[0]), scaled(b, sizes[1]), scaled(c, sizes[2])
    w, x, y, z, factor = quaternion
    g_w = z * (r0[1] - r1[0]) + y * (r2[0] - r0[2]) + x * (r1[2] - r2[1])
    g_x = y * (r1[0] + r0[1]) + z * (r2[0] + r0[2]) + w * (r1[2] - r2[1]) - x * TWO * (r1[1] + r2[2])
    g_y = x * (r1[0] + r0[1]) + z * (r2[1] + r1[2]) + w * (r2[0] - r0[2]) - y * TWO * (r0[0] + r2[2])
    g_z = x * (r2[0] + r0[2]) + y * (r2[1] + r1[2]) + w * (r0[1] - r1[0]) - z * TWO * (r0[0] + r1[1])
    # The quaternion was brought to the length √2: what is along it has no effect
    along = (w * g_w + x * g_x + y * g_y + z * g_z) * HALF
    for k in range(3):
        store(rows, (MEAN + k) * ROW, mean[k])
        store(rows, (LOG_SCALE + k) * ROW, log_scale[k])
    store(rows, QUATERNION * ROW, (g_w - w * along) * factor)
    store(rows, (QUATERNION + 1) * ROW, (g_x - x * along) * factor)
    store(rows, (QUATERNION + 2) * ROW, (g_y - y * along) * factor)
    store(rows, (QUATERNION + 3) * ROW, (g_z - z * along) * factor)
    store(rows, OPACITY_LOGIT * ROW, g_alpha * plain * (ONE - plain))


@inlined_part
@no_type_check
def scatter(chosen, block, rows, g_velocity, to):
    """Write the rows of a block to the gradients of its Gaussians. Each Gaussian is in one block."""
    moving = to.velocity_mps.shape[0] > 0
    if moving:  # otherwise these rows are the zeros of all blocks
        for k in range(3):
            store(rows, (VELOCITY + k) * ROW, g_velocity[k])
    for lane in range(min(ROW, chosen.size - block * ROW)):
        i = chosen[block * ROW + lane]
        for k in range(3):
            to.mean_m[i, k] = rows[(MEAN + k) * ROW + lane]
            to.log_scale[i, k] = rows[(LOG_SCALE + k) * ROW + lane]
            if moving:
                to.velocity_mps[i, k] = rows[(VELOCITY + k) * ROW + lane]
        for k in range(4):
            to.quaternion[i, k] = rows[(QUATERNION + k) * ROW + lane]
        to.opacity_logit[i] = rows[OPACITY_LOGIT * ROW + lane]
