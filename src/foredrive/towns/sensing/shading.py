"""Shading: from hits to colours, in numba functions that release the GIL."""

import math
from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float32, Int32

from foredrive.towns.place.materials import MaterialArrays, Texture
from foredrive.towns.sensing.lamps import lamp_light
from foredrive.towns.sensing.patterns import TEXTURE_WORDS
from foredrive.towns.sensing.sky import blurred_sky, sky
from foredrive.towns.sensing.textures import texture
from foredrive.towns.sensing.wet import (
    LEVEL_COS,
    WATER_MIRROR,
    WET_DARKENING,
    WET_SHINE,
    is_paved,
    water_film,
    water_mirror,
)

MISS = -1
SHADOW_OFFSET_M = 4e-3
WINDOW_RGB = (0.36, 0.24, 0.12)
"""Colour of a lit room, relative to surfaces that emit light."""

CLEAR_MIRROR = 0.25
"""Minimum gloss of a surface that mirrors single clouds. Less glossy surfaces are too rough."""

_FACADE, _FOLIAGE, _GLOW = int(Texture.FACADE), int(Texture.FOLIAGE), int(Texture.GLOW)
_ENCODED = (np.linspace(0.0, 1.0, 4096) ** (1 / 2.2) * 255 + 0.5).astype(np.uint8)
"""8-bit values of display brightness by 12-bit linear value."""


class Triangles(NamedTuple):
    """Triangles, as in `Mesh`."""

    xyz: Float32[np.ndarray, "F 3 3"]
    uvw: Float32[np.ndarray, "F 3 3"]
    material: Int32[np.ndarray, "F"]


class ActorArrays(NamedTuple):
    """A actors. Each one is a moved, scaled and painted shape from the triangles of all shapes."""

    T_world_unit: Float32[np.ndarray, "A 3 4"]
    first: Int32[np.ndarray, "A"]
    """First triangle of the actor's shape."""
    paint: Int32[np.ndarray, "A S"]
    """Materials that replace the shape's negative material numbers: -1 by the first, -2 by the second."""


class Hits(NamedTuple):
    """The ends of N rays."""

    t: Float32[np.ndarray, "N"]
    """Distance, m."""
    triangle: Int32[np.ndarray, "N"]
    """Triangle of the static world, or counted from the first triangle of the actor's shape; MISS for
    none."""
    actor: Int32[np.ndarray, "N"]
    """Row of `ActorArrays`, -1 for the static world."""
    u: Float32[np.ndarray, "N"]
    v: Float32[np.ndarray, "N"]
    """Barycentric coordinates of the second and third corner."""


class SceneArrays(NamedTuple):
    """Everything that rays can hit."""

    static: Triangles
    shapes: Triangles
    actors: ActorArrays
    materials: MaterialArrays


class Surfaces(NamedTuple):
    """The surfaces at the ends of N rays. Without meaning for a ray that missed."""

    material: Int32[np.ndarray, "N"]
    """MISS for a ray that missed."""
    xyz: Float32[np.ndarray, "N 3"]
    normal: Float32[np.ndarray, "N 3"]
    """Unit normal against the ray."""
    cosine: Float32[np.ndarray, "N"]
    """Cosine of the angle of incidence."""
    uvw: Float32[np.ndarray, "N 3"]
    """Texture coordinates."""
    extent: Float32[np.ndarray, "N 4"]
    """Extent of the ray's footprint: in the three texture coordinates, and on the surface, m."""


_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@_kernel
@no_type_check
def transform_rays(T, origin, direction, rows):
    """Transform the origins and directions [n 3] of the rays `rows` by T [3 4]."""
    origins, directions = np.empty((len(rows), 3), np.float32), np.empty((len(rows), 3), np.float32)
    for i in range(len(rows)):
        row = rows[i]
        x, y, z = origin[row, 0], origin[row, 1], origin[row, 2]
        dx, dy, dz = direction[row, 0], direction[row, 1], direction[row, 2]
        # Positions are transformed with the translation, directions without
        for a in range(3):
            origins[i, a] = T[a, 0] * x + T[a, 1] * y + T[a, 2] * z + T[a, 3]
            directions[i, a] = T[a, 0] * dx + T[a, 1] * dy + T[a, 2] * dz
    return origins, directions


def surfaces(
    scene: SceneArrays,
    hits: Hits,
    origin: Float32[np.ndarray, "N 3"],
    direction: Float32[np.ndarray, "N 3"],
    ray_rad: Float32[np.ndarray, "N"],
) -> Surfaces:
    """Look up the surfaces that rays hit. `ray_rad` is the angle between a ray and its neighbours, rad."""
    count = len(hits.t)
    out = Surfaces(
        np.full(count, MISS, np.int32),
        np.empty((count, 3), np.float32),
        np.zeros((count, 3), np.float32),
        np.empty(count, np.float32),
        np.empty((count, 3), np.float32),
        np.empty((count, 4), np.float32),
    )
    _find_surfaces(scene.static, scene.shapes, scene.actors, hits, origin, direction, ray_rad, out)
    return out


@_kernel
@no_type_check
def _find_surfaces(static, shapes, actors, hits, origin, direction, ray_rad, out):
    corner = np.empty((3, 3), np.float32)
    coordinate = np.empty((3, 3), np.float32)
    for i in range(len(hits.t)):
        triangle, actor = hits.triangle[i], hits.actor[i]
        if triangle == MISS:
            continue
        # Corners and texture coordinates: of the static world, or of an actor's shape moved to the world
        if actor < 0:
            material = static.material[triangle]
            for k in range(3):
                for a in range(3):
                    corner[k, a] = static.xyz[triangle, k, a]
                    coordinate[k, a] = static.uvw[triangle, k, a]
        else:
            row = actors.first[actor] + triangle
            material = shapes.material[row]
            # Paint slots have negative numbers
            if material < 0:
                material = actors.paint[actor, -1 - material]
            for k in range(3):
                x, y, z = shapes.xyz[row, k, 0], shapes.xyz[row, k, 1], shapes.xyz[row, k, 2]
                for a in range(3):
                    corner[k, a] = (
                        actors.T_world_unit[actor, a, 0] * x
                        + actors.T_world_unit[actor, a, 1] * y
                        + actors.T_world_unit[actor, a, 2] * z
                        + actors.T_world_unit[actor, a, 3]
                    )
                    coordinate[k, a] = shapes.uvw[row, k, a]
        out.material[i] = material
        t, u, v = hits.t[i], hits.u[i], hits.v[i]
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        # Edges from the first corner, and the normal by their cross product
        px, py, pz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
        qx, qy, qz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
        nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        scale = 1.0 / max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-20)
        cosine = (nx * dx + ny * dy + nz * dz) * scale
        # Turn the normal against the ray
        if cosine > 0.0:
            scale = -scale
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        cosine = max(abs(cosine), 1e-3)
        out.normal[i, 0], out.normal[i, 1], out.normal[i, 2] = nx, ny, nz
        out.cosine[i] = cosine
        out.xyz[i, 0] = origin[i, 0] + t * dx
        out.xyz[i, 1] = origin[i, 1] + t * dy
        out.xyz[i, 2] = origin[i, 2] + t * dz
        # Let g be the gradient of a coordinate within the triangle's plane. A ray that moves sideways by δ ⟂
        # d shifts the hit by δ - d (n·δ)/(n·d), and so the coordinate by h·δ, h = g - n (g·d)/(n·d).
        # Solve for the gradient in the basis of the two edges (Gram matrix)
        pp, pq, qq = px * px + py * py + pz * pz, px * qx + py * qy + pz * qz, qx * qx + qy * qy + qz * qz
        inverse = 1.0 / max(pp * qq - pq * pq, 1e-20)
        pd, qd = px * dx + py * dy + pz * dz, qx * dx + qy * dy + qz * dz
        # Width of the footprint across the ray
        width = t * ray_rad[i]
        for k in range(3):
            base = coordinate[0, k]
            # Interpolate the coordinate, then project the footprint onto it
            dp, dq = coordinate[1, k] - base, coordinate[2, k] - base
            out.uvw[i, k] = base + u * dp + v * dq
            r, s = (qq * dp - pq * dq) * inverse, (pp * dq - pq * dp) * inverse
            tilt = (r * pd + s * qd) / cosine
            hx, hy, hz = r * px + s * qx + nx * tilt, r * py + s * qy + ny * tilt, r * pz + s * qz + nz * tilt
            out.extent[i, k] = width * math.sqrt(hx * hx + hy * hy + hz * hz)
        out.extent[i, 3] = width / math.sqrt(cosine)


@_kernel
@no_type_check
def sun_rays(surfaces, t, sun, out_origin):
    """Return the indices of the hits that face the sun, and fill out_origin with the starts of rays towards
    it."""
    index = np.empty(len(t), np.int64)
    count = 0
    for i in range(len(t)):
        if surfaces.material[i] == MISS:
            continue
        nx, ny, nz = surfaces.normal[i, 0], surfaces.normal[i, 1], surfaces.normal[i, 2]
        if nx * sun[0] + ny * sun[1] + nz * sun[2] > 0.0:
            # Start off the surface, further at a distance, where coordinates are less precise
            offset = SHADOW_OFFSET_M + 2e-5 * t[i]
            out_origin[count, 0] = surfaces.xyz[i, 0] + offset * nx
            out_origin[count, 1] = surfaces.xyz[i, 1] + offset * ny
            out_origin[count, 2] = surfaces.xyz[i, 2] + offset * nz
            index[count] = i
            count += 1
    return index[:count]


@_kernel
@no_type_check
def _mirrored_surroundings(light, gloss, dx, dy, dz, nx, ny, nz, cosine, out):
    """Fill out [3] with the mirrored radiance of a surface of this gloss: the sky, or the street for low
    rays."""
    # Direction mirrored at the surface: d + 2 cos θ n
    rise = dz + 2.0 * cosine * nz
    mx, my, upward = dx + 2.0 * cosine * nx, dy + 2.0 * cosine * ny, max(rise, 0.05)
    if gloss > CLEAR_MIRROR:
        sky(light, mx, my, upward, out)
    else:
        blurred_sky(light, mx, my, upward, out)
    open_sky = min(max(3.0 * rise, 0.0), 1.0)  # close to the horizon a street mirrors its other side
    for c in range(3):
        out[c] = open_sky * min(out[c], 3.0) + (1.0 - open_sky) * light.street_rgb[c]


@_kernel
@no_type_check
def _lit_window(light, glass, chance):
    """Return the brightness of a room behind a window. `chance` is the window's random number, 0 for many."""
    if glass <= 0.0:
        return 0.0
    # Several windows in one footprint show the mean
    if chance <= 0.0:
        return light.lit_windows  # the mean of many
    # Another digit of the same random number decides whether the room is lit
    return 0.2 + 0.8 * chance if chance * 7.3 % 1.0 < light.lit_windows else 0.0


@_kernel
@no_type_check
def _direct_light(kind, facing, lit):
    """Return the share of the sun's light that a surface scatters. `facing` is the cosine to the sun."""
    if kind == _FOLIAGE:  # leaves scatter: softer than a flat surface
        return 0.45 + 0.55 * facing if lit else 0.12
    return facing if lit else 0.0


@_kernel
@no_type_check
def _gloss(gloss, glass, cosine):
    """Return the share of mirrored light; it rises at grazing angles (Schlick's approximation)."""
    gloss = min(1.0, gloss + 0.35 * glass)
    if gloss > 0.0:
        gloss = gloss + (1.0 - gloss) * (1.0 - cosine) ** 5 * (0.25 + glass)
    return gloss


@_kernel
@no_type_check
def shade(materials, surfaces, t, direction, lit, light, mirrored, given):
    """Return the radiance [N 3] along rays.

    Args:
        materials: `MaterialArrays`.
        surfaces: `Surfaces` that the rays hit.
        t: [N] distances of the hits, m.
        direction: [N 3] unit directions of the rays.
        lit: [N] whether the sun shines on each hit.
        light: `LightArrays`.
        mirrored: [N 3] radiance from the direction in which water mirrors, or [0 3] to use the sky's.
        given: [N 3] radiance of rays that need no shading, -1 for the others; or [0 3].
    """
    out = np.empty((len(t), 3), np.float32)
    colour, lamp = np.empty(TEXTURE_WORDS, np.float32), np.zeros(6, np.float32)
    mirror = np.empty(3, np.float32)
    by_lamps, wetness = len(light.lamps.lamp_index) > 0, light.air.wetness
    for i in range(len(t)):
        # Results of the central ray are taken over
        if len(given) > 0 and given[i, 0] >= 0.0:
            out[i, 0], out[i, 1], out[i, 2] = given[i, 0], given[i, 1], given[i, 2]
            continue
        material = surfaces.material[i]
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        # Rays into the sky
        if material == MISS:
            sky(light, dx, dy, dz, colour)
            out[i, 0], out[i, 1], out[i, 2] = colour[0], colour[1], colour[2]
            continue
        texture(materials, material, surfaces.xyz, surfaces.uvw, surfaces.extent, i, colour)
        kind, glass, cosine = materials.texture[material], colour[3], surfaces.cosine[i]
        nx, ny, nz = surfaces.normal[i, 0], surfaces.normal[i, 1], surfaces.normal[i, 2]
        # Sunlight by the cosine to the sun; mirrors by gloss, glass and water
        facing = max(nx * light.sun[0] + ny * light.sun[1] + nz * light.sun[2], 0.0)
        direct = _direct_light(kind, facing, lit[i])
        gloss = _gloss(materials.gloss[material], glass, cosine)
        film = 0.0
        # Water on level ground: darker below, and a mirror on top
        if wetness > 0.0 and nz > LEVEL_COS and is_paved(materials.surface[material]):
            film = water_film(wetness, materials.surface[material], surfaces.xyz, surfaces.extent, i)
            gloss = max(gloss, film * water_mirror(cosine))
            for c in range(3):
                colour[c] *= 1.0 - WET_DARKENING * min(2.0 * wetness, 1.0)
        # The mirror shows what the extra ray found, else the sky or the street
        if film > 0.0 and len(mirrored) > 0 and mirrored[i, 0] >= 0.0:
            mirror[0], mirror[1], mirror[2] = mirrored[i, 0], mirrored[i, 1], mirrored[i, 2]
        elif gloss > 0.0:
            _mirrored_surroundings(light, gloss, dx, dy, dz, nx, ny, nz, cosine, mirror)
        if by_lamps:
            x, y, z = surfaces.xyz[i, 0], surfaces.xyz[i, 1], surfaces.xyz[i, 2]
            lamp_light(light.lamps, x, y, z, nx, ny, nz, dx, dy, dz, WET_SHINE if film > 0.0 else 0.0, lamp)
        # Ambient light: from the sky above and from the ground below, by the normal's tilt
        up = 0.5 + 0.5 * nz
        haze = 1.0 - math.exp(-t[i] * light.air.extinction_per_m)
        window = _lit_window(light, glass, colour[5]) if kind == _FACADE else 0.0
        for c in range(3):
            # Diffuse light, then mirror, then lit windows, then haze in front of all
            ambient = light.sky_rgb[c] * up + light.bounce_rgb[c] * (1.0 - up)
            radiance = colour[c] * (light.sun_rgb[c] * direct + ambient + lamp[c])
            if kind == _GLOW:
                radiance = light.glow * colour[c]
            if gloss > 0.0:
                radiance = radiance * (1.0 - gloss) + gloss * mirror[c] + film * lamp[3 + c] * WATER_MIRROR
            radiance += window * glass * light.glow * WINDOW_RGB[c]
            out[i, c] = radiance * (1.0 - haze) + haze * light.haze_rgb[c]
    return out


@_kernel
@no_type_check
def develop(radiance, exposure, samples):
    """Convert radiances to 8-bit sRGB [pixels 3]. Each `samples` radiances in a row belong to one pixel."""
    count = len(radiance) // samples
    out = np.empty((count, 3), np.uint8)
    for pixel in range(count):
        for c in range(3):
            # Mean of the tone-mapped samples: bright samples do not spoil an edge
            total = 0.0
            for i in range(pixel * samples, (pixel + 1) * samples):
                x = radiance[i, c] * exposure
                # Narkowicz, ACES filmic tone mapping curve, 2015
                total += min(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 1.0)
            out[pixel, c] = _ENCODED[int(total / samples * 4095.0)]
    return out
