"""Numba kernels that project Gaussians to a camera or a lidar. `projection_back_kernels` has their gradients.

They compute what `camera` and `lidar` compute in PyTorch, sixteen Gaussians at a time, with all intermediate
values in registers. Results differ by rounding.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np

from foredrive.ops.vectors import (
    HALF,
    ONE,
    ROW,
    ZERO,
    atan2_row,
    exp2_row,
    floor_row,
    inlined_part,
    kernel,
    load_row,
    maximum,
    minimum,
    sqrt_row,
    store,
)

LOG2_E = np.float32(math.log2(math.e))
TWO, THREE, SIX = np.float32(2), np.float32(3), np.float32(6)
TURN, HALF_TURN = np.float32(2 * math.pi), np.float32(math.pi)
MIN_RATIO = np.float32(1e-12)
"""As `footprint.MIN_RATIO`."""
MAX_EXPONENT = np.float32(126)

# Rows of a block of Gaussians: what is gathered, then the time at which each is scanned.
MEAN, QUATERNION, LOG_SCALE, OPACITY_LOGIT, VELOCITY = 0, 3, 7, 10, 11
INPUTS = 14
SCANNED, OTHER = 14, 15
ROWS = 16
# Rows of the result.
OUTPUTS = 12
"""Mean (2), inverse covariance (3), opacity, range, range slope (2), velocity (2), range rate."""


class GaussianArrays(NamedTuple):
    """Fields of `Gaussians` without features, float32 and contiguous, and their velocities."""

    mean_m: np.ndarray
    quaternion: np.ndarray
    log_scale: np.ndarray
    opacity_logit: np.ndarray
    velocity_mps: np.ndarray
    """Float32[N 3], or Float32[0 3] if all are static."""


class SensorArrays(NamedTuple):
    """Where a sensor is, how it moves, and what it does to Gaussians."""

    T_sensor_scene: np.ndarray
    """Float32[12]: the rotation row by row, then the position."""
    twist: np.ndarray
    """Float32[6]."""
    epsilon: np.float32
    """Variance that a pixel or a beam adds."""
    compensate: bool


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
def rotated(T, x, y, z):
    """Return vectors in the axes of the sensor."""
    return (
        x * T[0] + y * T[1] + z * T[2],
        x * T[3] + y * T[4] + z * T[5],
        x * T[6] + y * T[7] + z * T[8],
    )


@inlined_part
@no_type_check
def cross(a, x, y, z):
    """Return the cross product of a vector with rows of vectors."""
    return z * a[1] - y * a[2], x * a[2] - z * a[0], y * a[0] - x * a[1]


@inlined_part
@no_type_check
def in_sensor(rows, sensor):
    """Return positions and relative velocities in the axes of the sensor."""
    T, linear, turn = sensor.T_sensor_scene, sensor.twist[:3], sensor.twist[3:]
    x, y, z = rotated(T, load_row(rows, 0), load_row(rows, ROW), load_row(rows, 2 * ROW))
    x, y, z = x + T[9], y + T[10], z + T[11]
    first = VELOCITY * ROW
    vx, vy, vz = load_row(rows, first), load_row(rows, first + ROW), load_row(rows, first + 2 * ROW)
    vx, vy, vz = rotated(T, vx, vy, vz)
    # v - v_sensor - ω × p
    tx, ty, tz = cross(turn, x, y, z)
    return x, y, z, vx - linear[0] - tx, vy - linear[1] - ty, vz - linear[2] - tz


@inlined_part
@no_type_check
def _factor(rows, T):
    """Return M = R S in the axes of the sensor, column by column: three for each axis of the Gaussian."""
    first = QUATERNION * ROW
    w, x, y, z = (
        load_row(rows, first),
        load_row(rows, first + ROW),
        load_row(rows, first + 2 * ROW),
        load_row(rows, first + 3 * ROW),
    )
    # Length √2: products are twice those of length 1
    scale = ONE / sqrt_row((w * w + x * x + y * y + z * z) * HALF)
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    first = LOG_SCALE * ROW
    a = exp2_row(minimum(load_row(rows, first) * LOG2_E, MAX_EXPONENT))
    b = exp2_row(minimum(load_row(rows, first + ROW) * LOG2_E, MAX_EXPONENT))
    c = exp2_row(minimum(load_row(rows, first + 2 * ROW) * LOG2_E, MAX_EXPONENT))
    xx, yy, zz, one = x * x, y * y, z * z, ONE
    ax, ay, az = rotated(T, (one - yy - zz) * a, (x * y + w * z) * a, (x * z - w * y) * a)
    bx, by, bz = rotated(T, (x * y - w * z) * b, (one - xx - zz) * b, (y * z + w * x) * b)
    cx, cy, cz = rotated(T, (x * z + w * y) * c, (y * z - w * x) * c, (one - xx - yy) * c)
    return ax, ay, az, bx, by, bz, cx, cy, cz


@inlined_part
@no_type_check
def dot(a, b, c, x, y, z):
    """Return dot products of vectors."""
    return a * x + b * y + c * z


@inlined_part
@no_type_check
def _footprint(a, b, c, d, e, f, epsilon):
    """Return the inverse of U Uᵀ + ε for rows U = (a b c; d e f), and the compensation of the opacity."""
    xx, xy, yy = a * a + b * b + c * c, a * d + b * e + c * f, d * d + e * e + f * f
    # Cauchy-Binet: det U Uᵀ is the sum of the squared minors, without cancellation
    m0, m1, m2 = a * e - b * d, a * f - c * d, b * f - c * e
    area = m0 * m0 + m1 * m1 + m2 * m2
    widened = area + (xx + yy) * epsilon + epsilon * epsilon
    one = ONE / widened
    ratio = sqrt_row(maximum(area * one, MIN_RATIO))
    return (yy + epsilon) * one, ZERO - xy * one, (xx + epsilon) * one, ratio


@inlined_part
@no_type_check
def _put(out, column, block, count, rows, value):
    """Write a row of the result. The last block of an array may be shorter."""
    begin = block * ROW
    if begin + ROW <= count:
        store(out, column * count + begin, value)
    else:
        # By way of the block's memory: what lies behind the end is dropped
        store(rows, 0, value)
        for lane in range(count - begin):
            out[column, begin + lane] = rows[lane]


@inlined_part
@no_type_check
def _opacity(rows, sensor, ratio):
    exponent = load_row(rows, OPACITY_LOGIT * ROW) * (ZERO - LOG2_E)
    opacity = ONE / (exp2_row(minimum(exponent, MAX_EXPONENT)) + ONE)
    return opacity * ratio if sensor.compensate else opacity


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
    rows, count = np.zeros(ROWS * ROW, np.float32), chosen.size
    for block in range(start, stop):
        gather(chosen, block, gaussians, rows)
        px, py, pz, vx, vy, vz = in_sensor(rows, sensor)
        near = ONE / pz
        x, y = px * near, py * near
        # Clamped to the image with its margin, where the Jacobian is taken
        wx = minimum(maximum(x, limits[0]), limits[2])
        wy = minimum(maximum(y, limits[1]), limits[3])
        fx, fy = K[0], K[1]
        if dist.size > 0:
            k1, k2, p1, p2, k3 = dist[0], dist[1], dist[2], dist[3], dist[4]
            r2 = wx * wx + wy * wy
            radial = r2 * (r2 * (r2 * k3 + k2) + k1) + ONE
            slope = (r2 * (r2 * (THREE * k3) + TWO * k2) + k1) * TWO
            xx = radial + slope * wx * wx + wy * (TWO * p1) + wx * (SIX * p2)
            xy = slope * wx * wy + wx * (TWO * p1) + wy * (TWO * p2)
            yy = radial + slope * wy * wy + wy * (SIX * p1) + wx * (TWO * p2)
            # Beyond the margin, the distortion is continued linearly
            dx, dy = x - wx, y - wy
            x = wx * radial + wx * wy * (TWO * p1) + (r2 + wx * wx * TWO) * p2 + xx * dx + xy * dy
            y = wy * radial + (r2 + wy * wy * TWO) * p1 + wx * wy * (TWO * p2) + xy * dx + yy * dy
            # Chain rule: Jacobian of the distortion times that of x/z and y/z
            j0, j1, j2 = xx * near * fx, xy * near * fx, (xx * wx + xy * wy) * near * (ZERO - fx)
            j3, j4, j5 = xy * near * fy, yy * near * fy, (xy * wx + yy * wy) * near * (ZERO - fy)
        else:
            zero = near * ZERO
            j0, j1, j2 = near * fx, zero, wx * near * (ZERO - fx)
            j3, j4, j5 = zero, near * fy, wy * near * (ZERO - fy)
        ax, ay, az, bx, by, bz, cx, cy, cz = _factor(rows, sensor.T_sensor_scene)
        xx, xy, yy, ratio = _footprint(
            dot(j0, j1, j2, ax, ay, az),
            dot(j0, j1, j2, bx, by, bz),
            dot(j0, j1, j2, cx, cy, cz),
            dot(j3, j4, j5, ax, ay, az),
            dot(j3, j4, j5, bx, by, bz),
            dot(j3, j4, j5, cx, cy, cz),
            sensor.epsilon,
        )
        opacity = _opacity(rows, sensor, ratio)
        _put(out, 0, block, count, rows, x * fx + K[2])
        _put(out, 1, block, count, rows, y * fy + K[3])
        _put(out, 2, block, count, rows, xx)
        _put(out, 3, block, count, rows, xy)
        _put(out, 4, block, count, rows, yy)
        _put(out, 5, block, count, rows, opacity)
        _put(out, 6, block, count, rows, pz)
        _put(out, 7, block, count, rows, near * ZERO)
        _put(out, 8, block, count, rows, near * ZERO)
        _put(out, 9, block, count, rows, dot(j0, j1, j2, vx, vy, vz))
        _put(out, 10, block, count, rows, dot(j3, j4, j5, vx, vy, vz))
        _put(out, 11, block, count, rows, vz)


@inlined_part
@no_type_check
def moved(x, y, z, vx, vy, vz, twist, t):
    """Return positions in the lidar's frame at another time, to second order, as `lidar._moved`."""
    linear, turn = twist[:3], twist[3:]
    # p'' = -ω × (2 v + u + ω × p)
    tx, ty, tz = cross(turn, x, y, z)
    ax, ay, az = cross(turn, vx * TWO + linear[0] + tx, vy * TWO + linear[1] + ty, vz * TWO + linear[2] + tz)
    half = t * HALF
    return x + t * (vx - half * ax), y + t * (vy - half * ay), z + t * (vz - half * az)


@inlined_part
@no_type_check
def _angles(x, y, z):
    """Return azimuth, elevation and range."""
    level2 = x * x + y * y
    return atan2_row(y, x), atan2_row(z, sqrt_row(level2)), sqrt_row(level2 + z * z)


@inlined_part
@no_type_check
def add_cross(row, t, turn):
    """Return a vector plus t · ω × it."""
    x, y, z = cross(turn, row[0], row[1], row[2])
    return row[0] + t * x, row[1] + t * y, row[2] + t * z


@inlined_part
@no_type_check
def _look_up(rows, place, azimuth, scan_s):
    """Write the times at which azimuths are scanned to a row."""
    sectors = scan_s.size
    store(rows, place * ROW, azimuth * (ONE / TURN) + HALF)
    for lane in range(ROW):
        turns = rows[place * ROW + lane]
        sector = int((turns - np.floor(turns)) * np.float32(sectors))
        rows[place * ROW + lane] = scan_s[min(sector, sectors - 1)]


@inlined_part
@no_type_check
def find_scan_times(rows, x, y, z, vx, vy, vz, twist, scan_s, turn_s):
    """Write the times at which a block's Gaussians are scanned, here and at the other side of the seam."""
    # By the azimuth at time 0, and once more by that at the time that this gives
    _look_up(rows, SCANNED, atan2_row(y, x), scan_s)
    x, y, z = moved(x, y, z, vx, vy, vz, twist, load_row(rows, SCANNED * ROW))
    _look_up(rows, SCANNED, atan2_row(y, x), scan_s)
    # The same azimuth a turn earlier or later
    for lane in range(ROW):
        time_s = rows[SCANNED * ROW + lane]
        rows[OTHER * ROW + lane] = time_s - turn_s if time_s > 0 else time_s + turn_s


@kernel
@no_type_check
def project_to_lidar(start, stop, chosen, gaussians, sensor, scan_s, turn_s, out):
    """Fill blocks start … stop - 1 of `out`, Float32[12 M], with the chosen Gaussians.

    Args:
        chosen: Int32[M].
        scan_s: Float32[S], result of `scan_times`, or Float32[0] for the motion at time 0.
        turn_s: time between the first and the last beam.
    """
    rows, count = np.zeros(ROWS * ROW, np.float32), chosen.size
    twist, turn = sensor.twist, sensor.twist[3:]
    for block in range(start, stop):
        gather(chosen, block, gaussians, rows)
        x, y, z, vx, vy, vz = in_sensor(rows, sensor)
        ax, ay, az, bx, by, bz, cx, cy, cz = _factor(rows, sensor.T_sensor_scene)
        qx, qy, qz, t = x, y, z, x * ZERO
        if scan_s.size > 0:
            find_scan_times(rows, x, y, z, vx, vy, vz, twist, scan_s, turn_s)
            t = load_row(rows, SCANNED * ROW)
            qx, qy, qz = moved(x, y, z, vx, vy, vz, twist, t)
        azimuth, elevation, range_m = _angles(qx, qy, qz)
        # Rows of the Jacobian: gradients of azimuth, elevation and range
        level2 = qx * qx + qy * qy
        level = sqrt_row(level2)
        flat, far2 = ONE / level2, ONE / (level2 + qz * qz)
        across, far = far2 / level, ONE / range_m
        j0, j1, j2 = (ZERO - qy) * flat, qx * flat, flat * ZERO
        j3, j4, j5 = (ZERO - qx * qz) * across, (ZERO - qy * qz) * across, level * far2
        j6, j7, j8 = qx * far, qy * far, qz * far
        if scan_s.size > 0:
            other = load_row(rows, OTHER * ROW)
            ox, oy, oz = moved(x, y, z, vx, vy, vz, twist, other)
            azimuth1, elevation1, range1 = _angles(ox, oy, oz)
            # The line through both places; azimuths differ across ±π
            per_s = ONE / (other - t)
            swing = azimuth1 - azimuth + HALF_TURN
            swing = swing - floor_row(swing * (ONE / TURN)) * TURN - HALF_TURN
            rate0, rate1, rate2 = swing * per_s, (elevation1 - elevation) * per_s, (range1 - range_m) * per_s
            azimuth, elevation, range_m = azimuth - t * rate0, elevation - t * rate1, range_m - t * rate2
            # Until then the axes turn by t · ω: J takes vectors in the axes at time 0
            j0, j1, j2 = add_cross((j0, j1, j2), t, turn)
            j3, j4, j5 = add_cross((j3, j4, j5), t, turn)
            j6, j7, j8 = add_cross((j6, j7, j8), t, turn)
        else:
            rate0, rate1 = dot(j0, j1, j2, vx, vy, vz), dot(j3, j4, j5, vx, vy, vz)
            rate2 = dot(j6, j7, j8, vx, vy, vz)
        a, b, c = (
            dot(j0, j1, j2, ax, ay, az),
            dot(j0, j1, j2, bx, by, bz),
            dot(j0, j1, j2, cx, cy, cz),
        )
        d, e, f = (
            dot(j3, j4, j5, ax, ay, az),
            dot(j3, j4, j5, bx, by, bz),
            dot(j3, j4, j5, cx, cy, cz),
        )
        g, h, k = (
            dot(j6, j7, j8, ax, ay, az),
            dot(j6, j7, j8, bx, by, bz),
            dot(j6, j7, j8, cx, cy, cz),
        )
        xx, xy, yy, ratio = _footprint(a, b, c, d, e, f, sensor.epsilon)
        # Covariance of the range with both angles gives the slope of its conditional mean
        with_azimuth, with_elevation = dot(a, b, c, g, h, k), dot(d, e, f, g, h, k)
        opacity = _opacity(rows, sensor, ratio)
        _put(out, 0, block, count, rows, azimuth)
        _put(out, 1, block, count, rows, elevation)
        _put(out, 2, block, count, rows, xx)
        _put(out, 3, block, count, rows, xy)
        _put(out, 4, block, count, rows, yy)
        _put(out, 5, block, count, rows, opacity)
        _put(out, 6, block, count, rows, range_m)
        _put(out, 7, block, count, rows, xx * with_azimuth + xy * with_elevation)
        _put(out, 8, block, count, rows, xy * with_azimuth + yy * with_elevation)
        _put(out, 9, block, count, rows, rate0)
        _put(out, 10, block, count, rows, rate1)
        _put(out, 11, block, count, rows, rate2)
