"""From hits to colours and to lidar returns, by numba kernels that release the GIL."""

import math
from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float32, Int32

from foredrive.towns.looks import LookArrays, Texture
from foredrive.towns.patterns import PAINT_REFLECTIVITY, noise, texture

MISS = -1
SHADOW_OFFSET_M = 4e-3
GLASS_LOSS = 0.8
"""Share of a lidar pulse that a window lets through or mirrors away."""
LIDAR_REFERENCE_M = 45.0
"""At this distance half of the pulses from a surface of 2 % reflectivity, met head-on, are lost."""
LIDAR_THRESHOLD = 0.02
FOLIAGE_DEPTH_M = 0.25

_FOLIAGE, _GLOW = int(Texture.FOLIAGE), int(Texture.GLOW)


class Soup(NamedTuple):
    """Triangles, as in `Mesh`."""

    xyz: Float32[np.ndarray, "F 3 3"]
    uvw: Float32[np.ndarray, "F 3 3"]
    look: Int32[np.ndarray, "F"]


class ActorArrays(NamedTuple):
    """A actors, each a shape of the actors' soup that is moved, stretched and painted."""

    T_world_unit: Float32[np.ndarray, "A 3 4"]
    first: Int32[np.ndarray, "A"]
    """First triangle of the actor's shape."""
    paint: Int32[np.ndarray, "A S"]
    """Looks that replace the shape's negative look numbers: -1 by the first, -2 by the second."""


class Hits(NamedTuple):
    """Where N rays end."""

    t: Float32[np.ndarray, "N"]
    """Distance, m."""
    triangle: Int32[np.ndarray, "N"]
    """Of the static soup, or counted from the first triangle of the actor's shape; MISS for none."""
    actor: Int32[np.ndarray, "N"]
    """Row of `ActorArrays`, -1 for the static world."""
    u: Float32[np.ndarray, "N"]
    v: Float32[np.ndarray, "N"]
    """Barycentric coordinates of the second and third corner."""


class Scene(NamedTuple):
    """All that rays can meet."""

    static: Soup
    shapes: Soup
    actors: ActorArrays
    looks: LookArrays


class _Work(NamedTuple):
    """Room for what is known of one hit."""

    corners: Float32[np.ndarray, "3 3"]
    uvw: Float32[np.ndarray, "3 3"]
    normal: Float32[np.ndarray, "3"]
    xyz: Float32[np.ndarray, "3"]
    at: Float32[np.ndarray, "3"]
    duvw: Float32[np.ndarray, "3"]
    colour: Float32[np.ndarray, "5"]
    mirror: Float32[np.ndarray, "5"]


_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@_kernel
@no_type_check
def _look_up(scene, hits, i, corners, uvw):
    """Fill the corners (world, 3×3) and texture coordinates (3×3) of a hit triangle; return its look."""
    actor, triangle = hits.actor[i], hits.triangle[i]
    if actor < 0:
        for k in range(3):
            for a in range(3):
                corners[k, a] = scene.static.xyz[triangle, k, a]
                uvw[k, a] = scene.static.uvw[triangle, k, a]
        return scene.static.look[triangle]
    row = scene.actors.first[actor] + triangle
    T = scene.actors.T_world_unit[actor]
    for k in range(3):
        p = scene.shapes.xyz[row, k]
        for a in range(3):
            corners[k, a] = T[a, 0] * p[0] + T[a, 1] * p[1] + T[a, 2] * p[2] + T[a, 3]
            uvw[k, a] = scene.shapes.uvw[row, k, a]
    look = scene.shapes.look[row]
    return look if look >= 0 else scene.actors.paint[actor, -1 - look]


@_kernel
@no_type_check
def _normal(corners, dx, dy, dz, normal):
    """Unit normal of a triangle, turned against the ray; return the ray's cosine with it."""
    ax, ay, az = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    bx, by, bz = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1], corners[2, 2] - corners[0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    scale = 1.0 / max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-20)
    cosine = (nx * dx + ny * dy + nz * dz) * scale
    if cosine > 0.0:
        scale = -scale
    normal[0], normal[1], normal[2] = nx * scale, ny * scale, nz * scale
    return max(abs(cosine), 1e-3)


@_kernel
@no_type_check
def _footprint(corners, uvw, normal, direction, cosine, width, duvw):
    """Extent of a pixel's footprint in the texture coordinates.

    With g the gradient of a coordinate within the triangle's plane, a ray that moves sideways by δ ⟂ d shifts
    the hit by δ - d (n·δ)/(n·d), hence the coordinate by h·δ, h = g - n (g·d)/(n·d).
    """
    e1, e2 = corners[1] - corners[0], corners[2] - corners[0]
    a = e1[0] * e1[0] + e1[1] * e1[1] + e1[2] * e1[2]
    b = e1[0] * e2[0] + e1[1] * e2[1] + e1[2] * e2[2]
    c = e2[0] * e2[0] + e2[1] * e2[1] + e2[2] * e2[2]
    inverse = 1.0 / max(a * c - b * b, 1e-20)
    for k in range(3):
        d1, d2 = uvw[1, k] - uvw[0, k], uvw[2, k] - uvw[0, k]
        s, r = (c * d1 - b * d2) * inverse, (a * d2 - b * d1) * inverse
        along = 0.0
        for x in range(3):
            along += (s * e1[x] + r * e2[x]) * direction[x]
        total = 0.0
        for x in range(3):
            h = s * e1[x] + r * e2[x] + normal[x] * along / cosine
            total += h * h
        duvw[k] = width * math.sqrt(total)


@_kernel
@no_type_check
def _sky(light, dx, dy, dz, out):
    """Radiance of the sky: a gradient, a glow about the sun, thin clouds."""
    up = max(dz, 0.0)
    blend = 1.0 - (1.0 - up) ** 5
    glow = max(dx * light.sun[0] + dy * light.sun[1] + dz * light.sun[2], 0.0)
    halo = 0.25 * glow**6 + 0.6 * glow**64
    disc = 8.0 if glow > 0.9995 else 0.0
    cloud = 0.0
    if dz > 0.02 and light.clouds > 0.0:
        x, y = dx / (dz + 0.12) * 1.3, dy / (dz + 0.12) * 1.3
        n = (
            noise(x, y, 0.0, 81)
            + 0.5 * noise(2.1 * x, 2.1 * y, 0.0, 82)
            + 0.25 * noise(4.3 * x, 4.3 * y, 0.0, 83)
        )
        cloud = min(max(1.1 * n + 1.6 * light.clouds - 0.8, 0.0), 1.0) * min(1.0, 6.0 * dz)
    for c in range(3):
        clear = light.horizon[c] * (1.0 - blend) + light.zenith[c] * blend
        clear += light.sun_rgb[c] * (0.12 * halo + disc)
        out[c] = clear * (1.0 - cloud) + cloud * light.cloud_rgb[c]


@_kernel
@no_type_check
def _make_work():
    three = np.empty((4, 3), np.float32)
    square = np.empty((2, 3, 3), np.float32)
    five = np.empty((2, 5), np.float32)
    return _Work(square[0], square[1], three[0], three[1], three[2], three[3], five[0], five[1])


@_kernel
@no_type_check
def sun_rays(scene, hits, origin, direction, light, out_origin):
    """Where rays towards the sun start, for hits that face it; return which ones do."""
    count = len(hits.t)
    wanted = np.zeros(count, dtype=np.bool_)
    work = _make_work()
    normal = work.normal
    for i in range(count):
        if hits.triangle[i] == MISS:
            continue
        d = direction[i]
        _look_up(scene, hits, i, work.corners, work.uvw)
        _normal(work.corners, d[0], d[1], d[2], normal)
        facing = normal[0] * light.sun[0] + normal[1] * light.sun[1] + normal[2] * light.sun[2]
        if facing > 0.0:
            wanted[i] = True
            offset = SHADOW_OFFSET_M + 2e-5 * hits.t[i]
            for a in range(3):
                out_origin[i, a] = origin[i, a] + hits.t[i] * d[a] + offset * normal[a]
    return wanted


@_kernel
@no_type_check
def _meet(scene, hits, i, origin, d, ray_rad, work):
    """Work out one hit: normal, position, texture. Return its look and the ray's cosine with the normal."""
    look = _look_up(scene, hits, i, work.corners, work.uvw)
    cosine = _normal(work.corners, d[0], d[1], d[2], work.normal)
    t, u, v = hits.t[i], hits.u[i], hits.v[i]
    for a in range(3):
        work.xyz[a] = origin[a] + t * d[a]
        work.at[a] = (1.0 - u - v) * work.uvw[0, a] + u * work.uvw[1, a] + v * work.uvw[2, a]
    width = t * ray_rad
    _footprint(work.corners, work.uvw, work.normal, d, cosine, width, work.duvw)
    looks = scene.looks
    texture(
        looks.texture[look],
        looks.params[look],
        looks.albedo[look],
        work.xyz,
        work.at,
        width / math.sqrt(cosine),
        work.duvw,
        look,
        work.colour,
    )
    return look, cosine


@_kernel
@no_type_check
def _shade(scene, hits, i, origin, d, ray_rad, lit, light, work):
    """Radiance along one ray, into work.colour[0:3]."""
    colour, normal = work.colour, work.normal
    if hits.triangle[i] == MISS:
        _sky(light, d[0], d[1], d[2], colour)
        return
    look, cosine = _meet(scene, hits, i, origin, d, ray_rad, work)
    kind, glass = scene.looks.texture[look], colour[3]
    facing = max(normal[0] * light.sun[0] + normal[1] * light.sun[1] + normal[2] * light.sun[2], 0.0)
    direct = facing if lit else 0.0
    if kind == _FOLIAGE:  # leaves scatter: softer than a flat surface
        direct = (0.35 + 0.65 * facing) if lit else 0.12
    up = 0.5 + 0.5 * normal[2]
    gloss = min(1.0, scene.looks.gloss[look] + 0.35 * glass)
    if gloss > 0.0:
        gloss = gloss + (1.0 - gloss) * (1.0 - cosine) ** 5 * (0.25 + glass)
        k = 2.0 * cosine
        rise = max(d[2] + k * normal[2], 0.05)
        _sky(light, d[0] + k * normal[0], d[1] + k * normal[1], rise, work.mirror)
    haze = 1.0 - math.exp(-hits.t[i] / light.visibility_m)
    for c in range(3):
        ambient = light.sky_rgb[c] * up + light.bounce_rgb[c] * (1.0 - up)
        radiance = colour[c] * (light.sun_rgb[c] * direct + ambient)
        if kind == _GLOW:
            radiance = 2.5 * colour[c]
        if gloss > 0.0:
            radiance = radiance * (1.0 - gloss) + gloss * min(work.mirror[c], 3.0)
        colour[c] = radiance * (1.0 - haze) + haze * light.haze_rgb[c]


@_kernel
@no_type_check
def shade_pixels(scene, hits, origin, direction, ray_rad, lit, light, samples):
    """8-bit sRGB colours [pixels 3] of rays of which `samples` in a row belong to one pixel.

    ray_rad is the angle between neighbouring rays, one for each ray.
    """
    count = len(hits.t) // samples
    out = np.empty((count, 3), np.uint8)
    work = _make_work()
    total = np.empty(3, np.float32)
    for pixel in range(count):
        total[:] = 0.0
        for i in range(pixel * samples, (pixel + 1) * samples):
            _shade(scene, hits, i, origin[i], direction[i], ray_rad[i], lit[i], light, work)
            for c in range(3):
                x = work.colour[c] * light.exposure
                # Narkowicz, ACES filmic tone mapping curve, 2015
                total[c] += min(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 1.0)
        for c in range(3):
            encoded = (total[c] / samples) ** (1.0 / 2.2)
            out[pixel, c] = np.uint8(min(encoded, 1.0) * 255.0 + 0.5)
    return out


@_kernel
@no_type_check
def lidar_returns(scene, hits, origin, direction, beam_rad, max_range_m, chance):
    """Which beams return, how strongly and from where.

    The echo of a surface of reflectivity ρ met at an angle θ falls with ρ cos θ / r²; it is lost with a
    probability that rises as the echo falls to the detector's threshold.

    Args:
        chance: [N 2] uniform random numbers: for the loss, and for the depth within foliage.

    Returns:
        range [N] m, up to the surface where a beam was lost; returned [N]; intensity [N] in 0..1
        (range-compensated).
    """
    count = len(hits.t)
    range_m = np.empty(count, np.float32)
    returned = np.zeros(count, np.bool_)
    intensity = np.zeros(count, np.float32)
    work = _make_work()
    for i in range(count):
        t = hits.t[i]
        range_m[i] = max_range_m
        if hits.triangle[i] == MISS or t > max_range_m:
            continue
        look, cosine = _meet(scene, hits, i, origin[i], direction[i], beam_rad, work)
        glass, paint = work.colour[3], work.colour[4]
        reflectivity = scene.looks.reflectivity[look] * (1.0 - paint) + PAINT_REFLECTIVITY * paint
        reflectivity *= 1.0 - GLASS_LOSS * glass
        range_m[i] = t
        echo = reflectivity * cosine * (LIDAR_REFERENCE_M / max(t, 1.0)) ** 2
        if chance[i, 0] < echo / (echo + LIDAR_THRESHOLD):
            returned[i] = True
            intensity[i] = min(reflectivity * (0.35 + 0.65 * cosine), 1.0)
            leafy = scene.looks.texture[look] == _FOLIAGE
            range_m[i] = t + (FOLIAGE_DEPTH_M * chance[i, 1] if leafy else 0.0)
    return range_m, returned, intensity
