"""Pitched roofs of buildings."""

import numpy as np

from foredrive.towns.place.mesh import Mesh, join, quads, triangles
from foredrive.towns.place.plot import Plot

EAVES_M = 0.45


def gable_roof(plot: Plot, eaves: float, ridge: float, roof: int, wall: int) -> Mesh:
    """Build two slopes of material `roof` that extend beyond the eaves, and gables of material `wall`."""
    w, d, e = plot.width_m, plot.depth_m, EAVES_M
    drop = (ridge - eaves) / (0.5 * d) * e
    slopes = []
    for y0, x0, x1 in ((-e, -e, w + e), (d + e, w + e, -e)):
        corners = [[x0, y0, eaves - drop], [x1, y0, eaves - drop]]
        corners += [[x1, 0.5 * d, ridge], [x0, 0.5 * d, ridge]]
        run = float(np.hypot(0.5 * d + e, ridge - eaves + drop))
        uvw = np.array([[[0, 0, 0], [w, 0, 0], [w, run, 0], [0, run, 0]]], float)
        top = np.array([corners])
        slopes += [quads(top, roof, uvw), quads(top[:, ::-1] - [0.0, 0.0, 0.15], roof, uvw)]
    peak = ridge - 0.1
    gables = np.array(
        [
            [[w, 0.0, eaves], [w, d, eaves], [w, 0.5 * d, peak]],
            [[0.0, d, eaves], [0.0, 0.0, eaves], [0.0, 0.5 * d, peak]],
        ]
    )
    # Without u and w a façade has no windows.
    return plot.placed(join([*slopes, triangles(gables, wall, np.zeros((2, 3, 3)))]))


def hip_roof(plot: Plot, eaves: float, ridge: float, roof: int) -> Mesh:
    """Build four slopes on a plot that is wider than deep."""
    w, d, e = plot.width_m, plot.depth_m, EAVES_M
    a, b, c, f = [-e, -e, eaves], [w + e, -e, eaves], [w + e, d + e, eaves], [-e, d + e, eaves]
    p, q = [0.5 * d, 0.5 * d, ridge], [w - 0.5 * d, 0.5 * d, ridge]
    run = float(np.hypot(0.5 * d + e, ridge - eaves))
    parts = [quads(np.array([[f, c, b, a]], float), roof)]
    for corners in ([a, b, q, p], [c, f, p, q]):
        uvw = np.array([[[0, 0, 0], [w, 0, 0], [w - 0.5 * d, run, 0], [0.5 * d, run, 0]]], float)
        parts.append(quads(np.array([corners], float), roof, uvw))
    for triangle in ([b, c, q], [f, a, p]):
        uvw = np.array([[[0, 0, 0], [d, 0, 0], [0.5 * d, run, 0]]], float)
        parts.append(triangles(np.array([triangle], float), roof, uvw))
    return plot.placed(join(parts))
