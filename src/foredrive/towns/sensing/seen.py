"""Records of the surfaces that rays hit."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float32, Int32

from foredrive.towns.sensing.shading import MISS, Hits


class Seen(NamedTuple):
    """The triangles and actors that rays hit, as in `Hits`."""

    triangle: Int32[np.ndarray, "N"]
    actor: Int32[np.ndarray, "N"]
    look: Int32[np.ndarray, "N"]
    """Look, `MISS` where a ray hit nothing."""
    range_m: Float32[np.ndarray, "N"]
    """Distance along the ray, m; infinite where it hit nothing."""


def nothing_seen(count: int) -> Seen:
    """Return an empty record for `count` rays."""
    triangle, actor, look = (np.empty(count, np.int32) for _ in range(3))
    return Seen(triangle, actor, look, np.empty(count, np.float32))


def note(seen: Seen, part: slice, hits: Hits, look: Int32[np.ndarray, "n"]) -> None:
    """Record the hits of some of the rays."""
    seen.triangle[part], seen.actor[part], seen.look[part] = hits.triangle, hits.actor, look
    seen.range_m[part] = np.where(look == MISS, np.inf, hits.t)


@numba.njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def track_ids(seen, of_actor, of_triangle, nobody):
    """Return the track id of each hit [N], from those of actors [A] and of the static world's triangles
    [F]."""
    out = np.empty(len(seen.triangle), np.int64)
    for i in range(len(out)):
        triangle, actor = seen.triangle[i], seen.actor[i]
        if triangle == MISS:
            out[i] = nobody
        else:
            out[i] = of_actor[actor] if actor >= 0 else of_triangle[triangle]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def surface_ids(seen, of_look, sky):
    """Return the surface of each hit [N], from the surfaces of looks [L]."""
    out = np.empty(len(seen.look), np.int8)
    for i in range(len(out)):
        out[i] = sky if seen.look[i] == MISS else of_look[seen.look[i]]
    return out
