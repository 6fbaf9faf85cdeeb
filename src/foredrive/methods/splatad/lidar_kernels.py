"""Numba kernels that project Gaussians to azimuth and elevation of a lidar, and their gradients."""

import math
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
    SLOPE,
    TIMES,
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
    minus,
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
from foredrive.ops.vectors import (
    HALF,
    ONE,
    ROW,
    ZERO,
    atan2_row,
    floor_row,
    inlined_part,
    kernel,
    load_row,
    sqrt_row,
    store,
)

TURN, HALF_TURN = np.float32(2 * math.pi), np.float32(math.pi)
SCANNED, OTHER = TIMES, TIMES + 1
"""Rows of the times at which a Gaussian is scanned, here and at the other side of the seam."""


@inlined_part
@no_type_check
def _change(p, v, twist):
    """Return 2 v + u + ω × p: the acceleration in the moving frame is -ω × that (`lidar._moved`)."""
    x, y, z = plus(scaled(v, TWO), cross(twist[3:], p))
    return x + twist[0], y + twist[1], z + twist[2]


@inlined_part
@no_type_check
def _moved(p, v, twist, t):
    """Return positions in the lidar's frame at another time, to second order."""
    curve = cross(twist[3:], _change(p, v, twist))
    return plus(p, scaled(minus(v, scaled(curve, t * HALF)), t))


@inlined_part
@no_type_check
def _angles(p):
    """Return azimuth, elevation and range."""
    x, y, z = p
    level2 = x * x + y * y
    return atan2_row(y, x), atan2_row(z, sqrt_row(level2)), sqrt_row(level2 + z * z)


@inlined_part
@no_type_check
def _jacobian(p):
    """Return the gradients of azimuth, elevation and range by the position."""
    x, y, z = p
    level2 = x * x + y * y
    level, range2 = sqrt_row(level2), level2 + z * z
    flat, out = ONE / level2, ONE / sqrt_row(range2)
    up = ONE / (range2 * level)
    return (
        (ZERO - y * flat, x * flat, x * ZERO),
        (ZERO - x * z * up, ZERO - y * z * up, level2 * up),
        (x * out, y * out, z * out),
    )


@inlined_part
@no_type_check
def _turned(a, t, turn):
    """Return a vector plus t · ω × it."""
    return plus(a, scaled(cross(turn, a), t))


@inlined_part
@no_type_check
def _look_up(rows, place, azimuth, scan_s):
    """Write the times at which azimuths are scanned to a row."""
    sectors = scan_s.size
    store(rows, place * ROW, azimuth * (ONE / TURN) + HALF)
    for lane in range(ROW):
        turns = rows[place * ROW + lane]
        share = turns - np.floor(turns)
        # A place that is not finite must not become an index; its angles tell of it
        sector = int(share * np.float32(sectors)) if share >= ZERO else 0
        rows[place * ROW + lane] = scan_s[min(sector, sectors - 1)]


@inlined_part
@no_type_check
def _find_scan_times(rows, p, v, twist, scan_s, turn_s):
    """Write the times at which a block's Gaussians are scanned, here and at the other side of the seam."""
    # By the azimuth at time 0, and once more by that at the time that this gives
    _look_up(rows, SCANNED, atan2_row(p[1], p[0]), scan_s)
    q = _moved(p, v, twist, load_row(rows, SCANNED * ROW))
    _look_up(rows, SCANNED, atan2_row(q[1], q[0]), scan_s)
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
    rows, twist, turn = np.zeros(ALL_ROWS * ROW, np.float32), sensor.twist, sensor.twist[3:]
    for block in range(start, stop):
        gather(chosen, block, gaussians, rows)
        p, v = in_sensor(rows, sensor)
        q, t = p, p[0] * ZERO
        if scan_s.size > 0:
            _find_scan_times(rows, p, v, twist, scan_s, turn_s)
            t = load_row(rows, SCANNED * ROW)
            q = _moved(p, v, twist, t)
        azimuth, elevation, range_m = _angles(q)
        j, k, m = _jacobian(q)
        rates = (dot(j, v), dot(k, v), dot(m, v))
        if scan_s.size > 0:
            other = load_row(rows, OTHER * ROW)
            beyond = _angles(_moved(p, v, twist, other))
            # The line through both places; azimuths differ across ±π
            swing = beyond[0] - azimuth + HALF_TURN
            swing = swing - floor_row(swing * (ONE / TURN)) * TURN - HALF_TURN
            rates = scaled((swing, beyond[1] - elevation, beyond[2] - range_m), ONE / (other - t))
            azimuth, elevation, range_m = minus((azimuth, elevation, range_m), scaled(rates, t))
            # Until then the axes turn by t · ω: J takes vectors in the axes at time 0
            j, k, m = _turned(j, t, turn), _turned(k, t, turn), _turned(m, t, turn)
        columns, sizes, _ = shape(rows)
        M = in_axes(sensor.T_sensor_scene, factor_columns(columns, sizes))
        u, w, out_of = through(j, M), through(k, M), through(m, M)
        inverse, ratio = footprint(u, w, sensor.epsilon)
        xx, xy, yy = inverse
        # Covariance of the range with both angles gives the slope of its conditional mean
        with_azimuth, with_elevation = dot(u, out_of), dot(w, out_of)
        slope = (xx * with_azimuth + xy * with_elevation, xy * with_azimuth + yy * with_elevation)
        alpha = opacity(rows)
        if sensor.compensate:
            alpha = alpha * compensation(ratio)
        put_splats(out, block, rows, (azimuth, elevation), inverse, alpha, range_m, slope, rates, rates[2])


@inlined_part
@no_type_check
def _angles_back(p, g):
    """Return the gradient of positions for those of their angles and ranges."""
    j, k, m = _jacobian(p)
    return plus(plus(scaled(j, g[0]), scaled(k, g[1])), scaled(m, g[2]))


@inlined_part
@no_type_check
def _jacobian_back(p, g_azimuth, g_elevation, g_range):
    """Return the gradient of positions for those of the three rows of the Jacobian."""
    x, y, z = p
    level2 = x * x + y * y
    level, range2 = sqrt_row(level2), level2 + z * z
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
    per = ONE / sqrt_row(range2)
    along = scaled(p, dot(p, g_range) * per * per)
    return plus((g_x, g_y, g_z), scaled(minus(g_range, along), per))


@inlined_part
@no_type_check
def _moved_back(p, v, twist, t, g_q, g_p, g_v, g_twist):
    """Add the gradients of positions at another time (`_moved`) to those of position, velocity and twist."""
    turn, change = twist[3:], _change(p, v, twist)
    # p + t v + t²/2 p'' with p'' = -ω × change
    g_a = scaled(g_q, t * t * HALF)
    g_change = cross(turn, g_a)
    g_p = minus(plus(g_p, g_q), cross(turn, g_change))
    g_v = plus(plus(g_v, scaled(g_q, t)), scaled(g_change, TWO))
    g_turn = plus(minus(g_twist[1], cross(change, g_a)), cross(p, g_change))
    return g_p, g_v, (plus(g_twist[0], g_change), g_turn)


@inlined_part
@no_type_check
def _footprint_and_slope_back(rows, sensor, plain, u, w, out_of):
    """Return the gradients of J M by rows (azimuth, elevation, range), and of the opacity."""
    inverse, _ = footprint(u, w, sensor.epsilon)
    xx, xy, yy = inverse
    s0, s1 = gradient(rows, SLOPE), gradient(rows, SLOPE + 1)
    with_u, with_w = dot(u, out_of), dot(w, out_of)
    # Slope of the range: inverse footprint times the covariance of the range with both angles
    g_inverse = (
        gradient(rows, INVERSE) + s0 * with_u,
        gradient(rows, INVERSE + 1) + s0 * with_w + s1 * with_u,
        gradient(rows, INVERSE + 2) + s1 * with_w,
    )
    g_with_u, g_with_w = s0 * xx + s1 * xy, s0 * xy + s1 * yy
    g_u, g_w, g_alpha = footprint_back(u, w, sensor, plain, g_inverse, gradient(rows, OPACITY))
    g_u, g_w = plus(g_u, scaled(out_of, g_with_u)), plus(g_w, scaled(out_of, g_with_w))
    return g_u, g_w, plus(scaled(u, g_with_u), scaled(w, g_with_w)), g_alpha


@kernel
@no_type_check
def project_to_lidar_backward(start, stop, chosen, gaussians, sensor, scan_s, turn_s, gradients, to, sums):
    """Write the gradients of `project_to_lidar`.

    `gradients`, `to` and `sums` are those of `project_to_camera_backward`.
    """
    rows, twist, turn = np.zeros(ALL_ROWS * ROW, np.float32), sensor.twist, sensor.twist[3:]
    for block in range(start, stop):
        gather(chosen, block, gaussians, rows)
        gather_gradients(block, chosen.size, gradients, rows)
        p, v = in_sensor(rows, sensor)
        q, t, zero = p, p[0] * ZERO, p[0] * ZERO
        if scan_s.size > 0:
            _find_scan_times(rows, p, v, twist, scan_s, turn_s)
            t = load_row(rows, SCANNED * ROW)
            q = _moved(p, v, twist, t)
        j0, k0, m0 = _jacobian(q)
        # Without scan times t is 0, which turns nothing
        j, k, m = _turned(j0, t, turn), _turned(k0, t, turn), _turned(m0, t, turn)
        shapes = shape(rows)
        M_scene = factor_columns(shapes[0], shapes[1])
        M = in_axes(sensor.T_sensor_scene, M_scene)
        plain = opacity(rows)
        g_u, g_w, g_out, g_alpha = _footprint_and_slope_back(
            rows, sensor, plain, through(j, M), through(k, M), through(m, M)
        )
        g_j, g_M = through_back(g_u, j, M)
        g_k, more = through_back(g_w, k, M)
        g_m, last = through_back(g_out, m, M)
        g_M = plus_columns(plus_columns(g_M, more), last)
        nothing = (zero, zero, zero)
        g_p, g_v, g_twist = nothing, nothing, (nothing, nothing)
        g = (gradient(rows, CENTRE), gradient(rows, CENTRE + 1), gradient(rows, RANGE))
        g_rates = (gradient(rows, RATE), gradient(rows, RATE + 1), gradient(rows, RANGE_RATE))
        if scan_s.size > 0:
            other = load_row(rows, OTHER * ROW)
            # The line through both places at time 0: here - t · rate, rate = (beyond - here) / (other - t)
            g_beyond = scaled(minus(g_rates, scaled(g, t)), ONE / (other - t))
            g_o = _angles_back(_moved(p, v, twist, other), g_beyond)
            g_p, g_v, g_twist = _moved_back(p, v, twist, other, g_o, g_p, g_v, g_twist)
            g = minus(g, g_beyond)
            # J + t · ω × J
            turned = plus(plus(cross(j0, g_j), cross(k0, g_k)), cross(m0, g_m))
            g_twist = (g_twist[0], plus(g_twist[1], scaled(turned, t)))
            back = ZERO - t
            g_j, g_k, g_m = _turned(g_j, back, turn), _turned(g_k, back, turn), _turned(g_m, back, turn)
        else:
            # The tangent at time 0: rates are J v
            g_j, g_k = plus(g_j, scaled(v, g_rates[0])), plus(g_k, scaled(v, g_rates[1]))
            g_m = plus(g_m, scaled(v, g_rates[2]))
            g_v = plus(plus(scaled(j, g_rates[0]), scaled(k, g_rates[1])), scaled(m, g_rates[2]))
        # Without scan times t is 0, and the place is the position
        g_q = plus(_angles_back(q, g), _jacobian_back(q, g_j, g_k, g_m))
        g_p, g_v, g_twist = _moved_back(p, v, twist, t, g_q, g_p, g_v, g_twist)
        g_p = plus(g_p, cross(turn, g_v))
        if sums.shape[1] > 0:
            sum_gradients(rows, M_scene, p, g_M, g_p, g_v, g_twist, sums[block])
        store_gradients(rows, sensor, shapes, M_scene, plain, g_alpha, g_M, g_p, g_v)
        scatter(chosen, block, rows, rotated_back(sensor.T_sensor_scene, g_v), to)
