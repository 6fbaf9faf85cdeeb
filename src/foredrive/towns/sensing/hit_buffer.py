"""Records of the surfaces that rays hit."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float32, Int32

from foredrive.towns.sensing.shading import MISS, Hits


class HitBuffer(NamedTuple):
    """The triangles and actors that rays hit, as in `Hits`."""

    triangle: Int32[np.ndarray, "N"]
    actor: Int32[np.ndarray, "N"]
    material: Int32[np.ndarray, "N"]
    """Look, `MISS` where a ray hit nothing."""
    range_m: Float32[np.ndarray, "N"]
    """Distance along the ray, m; infinite where it hit nothing."""


def empty_hit_buffer(count: int) -> HitBuffer:
    """Return an empty record for `count` rays."""
    triangle, actor, material = (np.empty(count, np.int32) for _ in range(3))
    return HitBuffer(triangle, actor, material, np.empty(count, np.float32))


def record_hits(buffer: HitBuffer, part: slice, hits: Hits, material: Int32[np.ndarray, "n"]) -> None:
    """Record the hits of some of the rays."""
    buffer.triangle[part], buffer.actor[part], buffer.material[part] = hits.triangle, hits.actor, material
    buffer.range_m[part] = np.where(material == MISS, np.inf, hits.t)


@numba.njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def track_ids(buffer, of_actor, of_triangle, no_actor):
    """Return the track id of each hit [N], from those of actors [A] and of the static world's triangles
    [F]."""
    out = np.empty(len(buffer.triangle), np.int64)
    for i in range(len(out)):
        triangle, actor = buffer.triangle[i], buffer.actor[i]
        if triangle == MISS:
            out[i] = no_actor
        else:
            out[i] = of_actor[actor] if actor >= 0 else of_triangle[triangle]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def surface_ids(buffer, of_material, sky):
    """Return the surface of each hit [N], from the surfaces of materials [L]."""
    out = np.empty(len(buffer.material), np.int8)
    for i in range(len(out)):
        out[i] = sky if buffer.material[i] == MISS else of_material[buffer.material[i]]
    return out
