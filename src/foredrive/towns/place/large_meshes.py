"""Meshes of vans, trucks and buses. Units are metres; x points ahead; vehicles stand on z = 0."""

import numpy as np

from foredrive.towns.place.actor_materials import BODY, SECOND, MeshMaterials
from foredrive.towns.place.car_meshes import wheels
from foredrive.towns.place.mesh import Mesh, box, frustum, hexahedron, join


def taper(
    x: tuple[float, float],
    z: tuple[float, float],
    half_width: tuple[float, float],
    inset: tuple[float, float],
    mats: tuple[int, int, int],
) -> Mesh:
    """Build a solid from a horizontal rectangle up to a smaller one.

    Args:
        x: rear and front of the lower rectangle, m.
        z: heights of the two rectangles, m.
        half_width: half widths of the lower and the upper rectangle, m.
        inset: distances by which the upper rectangle is shorter at the rear and at the front, m.
        mats: materials of the top, the ends and the sides.
    """
    (x0, x1), (z0, z1), (w0, w1) = x, z, half_width
    top, ends, sides = mats
    # The upper rectangle is shorter at the rear and at the front
    a, b = x0 + inset[0], x1 - inset[1]
    return hexahedron(
        [[x0, -w0, z0], [x1, -w0, z0], [x1, w0, z0], [x0, w0, z0]],
        [[a, -w1, z1], [b, -w1, z1], [b, w1, z1], [a, w1, z1]],
        [sides, top, sides, ends, sides, ends],
    )


def van(mats: MeshMaterials) -> Mesh:
    """Build a panel van with a sloping nose."""
    w = 1.0
    parts = [
        # Body, upper body, side windows, windscreen; then doors, bumper, grille and trim
        taper((-2.7, 2.7), (0.25, 1.05), (w, w), (0.0, 0.12), (BODY, BODY, BODY)),
        taper((-2.7, 2.58), (1.05, 2.3), (w, w - 0.12), (0.04, 1.15), (BODY, BODY, BODY)),
        taper((1.05, 2.44), (1.15, 1.85), (w - 0.003, w - 0.07), (0.0, 0.64), (BODY, mats.glass, mats.glass)),
        taper((0.9, 2.5), (1.14, 2.05), (w - 0.12, w - 0.2), (0.0, 0.82), (BODY, mats.glass, BODY)),
        box((-2.72, -0.75, 1.25), (-2.68, -0.04, 1.85), mats.glass),
        box((-2.72, 0.04, 1.25), (-2.68, 0.75, 1.85), mats.glass),
        box((-2.71, -0.015, 0.4), (-2.69, 0.015, 2.2), mats.dark),
        box((2.55, -w + 0.1, 0.3), (2.74, w - 0.1, 0.6), mats.dark),
        box((2.5, -0.5, 0.72), (2.66, 0.5, 0.95), mats.dark),
        box((-2.5, -w - 0.01, 0.45), (2.4, w + 0.01, 0.56), mats.dark),
        wheels((-1.7, 1.75), w, 0.36, mats, mats.dark),
    ]
    return join([*parts, *_fittings(mats, (-2.7, 2.7), w, 0.78, 0.95)])


def panel_van(mats: MeshMaterials) -> Mesh:
    """Build a box-shaped van with windows along its sides."""
    w = 1.0
    parts = [
        taper((-2.6, 2.6), (0.25, 1.15), (w, w), (0.0, 0.03), (BODY, BODY, BODY)),
        taper((-2.6, 2.57), (1.15, 1.95), (w, w - 0.07), (0.05, 0.3), (BODY, mats.glass, mats.glass)),
        taper((-2.56, 2.28), (1.95, 2.3), (w - 0.06, w - 0.14), (0.05, 0.2), (BODY, BODY, BODY)),
        box((2.45, -w + 0.1, 0.3), (2.64, w - 0.1, 0.55), mats.dark),
        wheels((-1.6, 1.7), w, 0.36, mats, mats.dark),
    ]
    for x in (-2.3, -1.2, 0.0, 1.15):
        parts.append(taper((x, x + 0.14), (1.13, 1.97), (w + 0.004, w - 0.066), (0.0, 0.0), (BODY,) * 3))
    return join([*parts, *_fittings(mats, (-2.6, 2.6), w, 0.75, 0.85)])


def truck(mats: MeshMaterials) -> Mesh:
    """Build a truck: a cab in front of a box."""
    w = 1.2
    parts = [
        *_cab(mats, w),
        box((-3.6, -w, 0.95), (1.5, w, 3.3), SECOND),
        box((-3.62, -0.02, 1.0), (-3.59, 0.02, 3.25), mats.dark),
        wheels((-2.4, 2.5), w, 0.5, mats, None),
        wheels((-1.3,), w, 0.5, mats, None),
    ]
    for side in (-1.0, 1.0):  # guard below the box
        parts.append(box((-0.7, side * 1.12 - 0.03, 0.5), (1.5, side * 1.12 + 0.03, 0.85), mats.dark))
    return join([*parts, *_fittings(mats, (-3.6, 3.6), w, 0.75, 0.82)])


def tanker(mats: MeshMaterials) -> Mesh:
    """Build a tanker: a cab in front of a round tank."""
    w = 1.2
    parts = [
        *_cab(mats, w),
        frustum((-3.5, 0, 1.95), (1.4, 0, 1.95), (1.1, 1.1), 14, SECOND),
        frustum((-3.62, 0, 1.95), (-3.5, 0, 1.95), (0.8, 1.1), 14, SECOND),
        frustum((1.4, 0, 1.95), (1.52, 0, 1.95), (1.1, 0.8), 14, SECOND),
        box((-3.6, -w, 0.95), (-3.5, w, 1.35), mats.dark),
        wheels((-2.9, -1.8, 2.5), w, 0.5, mats, None),
    ]
    parts += [frustum((x, 0, 3.0), (x, 0, 3.3), (0.3, 0.3), 8, mats.hub) for x in (-2.4, -1.0, 0.4)]
    return join([*parts, *_fittings(mats, (-3.6, 3.6), w, 0.75, 0.82)])


def _cab(mats: MeshMaterials, w: float) -> list[Mesh]:
    return [
        box((-3.6, -0.5, 0.6), (3.3, 0.5, 0.95), mats.dark),
        taper((1.7, 3.6), (0.45, 1.4), (w - 0.05, w - 0.05), (0.0, 0.05), (BODY, BODY, BODY)),
        taper((1.7, 3.55), (1.4, 2.3), (w - 0.05, w - 0.15), (0.05, 0.25), (BODY, BODY, BODY)),
        taper((2.3, 3.35), (1.45, 2.15), (w - 0.04, w - 0.12), (0.0, 0.25), (BODY, mats.glass, mats.glass)),
        taper((2.0, 3.56), (1.45, 2.2), (w - 0.15, w - 0.22), (0.0, 0.21), (BODY, mats.glass, BODY)),
        taper((1.75, 3.28), (2.3, 2.95), (w - 0.15, w - 0.2), (0.0, 0.7), (BODY, BODY, BODY)),
        box((3.5, -w + 0.15, 0.45), (3.66, w - 0.15, 0.72), mats.dark),
        box((3.5, -0.7, 0.95), (3.61, 0.7, 1.3), mats.dark),
        box((-3.66, -1.0, 0.55), (-3.55, 1.0, 0.75), mats.dark),
    ]


def bus(mats: MeshMaterials) -> Mesh:
    """Build a city bus with doors on its right."""
    w = 1.23
    parts = [
        box((-5.2, -w, 0.35), (5.2, w, 1.15), BODY),
        taper((-5.2, 5.2), (1.15, 2.45), (w - 0.01, w - 0.03), (0.05, 0.12), (BODY, mats.glass, mats.glass)),
        taper((-5.2, 5.15), (2.45, 3.05), (w, w - 0.08), (0.05, 0.05), (SECOND, BODY, BODY)),
        box((5.1, -0.8, 2.55), (5.2, 0.8, 2.85), mats.orange),
        box((-3.4, -0.7, 3.05), (-0.8, 0.7, 3.3), SECOND),
        box((5.15, -w + 0.1, 0.4), (5.24, w - 0.1, 0.6), mats.dark),
        wheels((-2.9, 3.0), w, 0.48, mats, mats.dark),
    ]
    parts += [
        box((x, -w - 0.002, 1.15), (x + 0.1, w + 0.002, 2.45), BODY) for x in np.arange(-4.2, 4.5, 1.45)
    ]
    for x in (-0.6, 3.95):
        parts.append(box((x, -w - 0.006, 0.4), (x + 1.15, -w + 0.05, 2.4), mats.glass))
        parts.append(box((x + 0.55, -w - 0.01, 0.4), (x + 0.6, -w + 0.05, 2.4), mats.dark))
    return join([*parts, *_fittings(mats, (-5.2, 5.2), w, 0.7, 1.0)])


def coach(mats: MeshMaterials) -> Mesh:
    """Build a touring coach with a raised floor."""
    w = 1.24
    parts = [
        taper((-5.6, 5.6), (0.35, 1.6), (w, w), (0.0, 0.1), (BODY, BODY, BODY)),
        taper((-5.6, 5.5), (1.6, 2.75), (w - 0.01, w - 0.05), (0.1, 0.35), (BODY, mats.glass, mats.glass)),
        taper((-5.5, 5.15), (2.75, 3.3), (w - 0.05, w - 0.2), (0.1, 0.4), (SECOND, BODY, BODY)),
        taper((3.4, 5.56), (1.1, 1.62), (w - 0.3, w - 0.3), (0.0, 0.02), (BODY, mats.glass, BODY)),
        box((-4.8, -w - 0.004, 0.5), (4.3, w + 0.004, 0.62), SECOND),
        box((5.45, -w + 0.1, 0.4), (5.64, w - 0.1, 0.62), mats.dark),
        wheels((-3.4, -2.2, 3.3), w, 0.5, mats, mats.dark),
    ]
    return join([*parts, *_fittings(mats, (-5.6, 5.6), w, 0.75, 1.1)])


def _fittings(
    mats: MeshMaterials, x: tuple[float, float], w: float, front_z: float, rear_z: float
) -> list[Mesh]:
    """Build lights, plates and mirrors."""
    rear, front = x
    parts = [
        box((rear - 0.05, -0.26, 0.62), (rear + 0.02, 0.26, 0.73), mats.plate),
        box((front, -0.26, 0.4), (front + 0.06, 0.26, 0.51), mats.plate),
    ]
    for side in (-1.0, 1.0):
        y0, y1 = sorted((side * (w - 0.08), side * (w - 0.4)))
        parts.append(
            box((front - 0.15, y0, front_z - 0.1), (front + 0.015, y1, front_z + 0.1), mats.front_light)
        )
        y0, y1 = sorted((side * (w - 0.03), side * (w - 0.2)))
        parts.append(box((rear - 0.02, y0, rear_z - 0.2), (rear + 0.1, y1, rear_z + 0.2), mats.rear_light))
        y0, y1 = sorted((side * (w - 0.03), side * (w + 0.12)))
        parts.append(box((front - 0.75, y0, 1.35), (front - 0.6, y1, 1.7), mats.dark))
    return parts
