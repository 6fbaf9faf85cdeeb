"""What rays met, and whose it is."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float32, Int32

from foredrive.towns.sensing.shading import MISS, Hits


class Seen(NamedTuple):
    """What rays met: which triangle of which actor, as in `Hits`."""

    triangle: Int32[np.ndarray, "N"]
    actor: Int32[np.ndarray, "N"]
    look: Int32[np.ndarray, "N"]
    """`MISS` where a ray met nothing."""
    range_m: Float32[np.ndarray, "N"]
    """Along the ray; infinite where it met nothing."""


def nothing_seen(count: int) -> Seen:
    """Room for what rays will have met."""
    triangle, actor, look = (np.empty(count, np.int32) for _ in range(3))
    return Seen(triangle, actor, look, np.empty(count, np.float32))


def note(seen: Seen, part: slice, hits: Hits, look: Int32[np.ndarray, "n"]) -> None:
    """Write down what some of the rays met."""
    seen.triangle[part], seen.actor[part], seen.look[part] = hits.triangle, hits.actor, look
    seen.range_m[part] = np.where(look == MISS, np.inf, hits.t)


@numba.njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def track_ids(seen, of_actor, of_triangle, nobody):
    """Whose it is that rays met [N]: track ids of actors [A], of the static world's triangles [F]."""
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
    """What it is made of [N], by the surfaces of looks [L]."""
    out = np.empty(len(seen.look), np.int8)
    for i in range(len(out)):
        out[i] = sky if seen.look[i] == MISS else of_look[seen.look[i]]
    return out
