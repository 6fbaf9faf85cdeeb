"""Meshes of road users, in metres at a usual size, x ahead, standing on z = 0."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from foredrive.towns.place.looks import Look, LookTable, Surface, Texture
from foredrive.towns.place.mesh import Mesh, box, frustum, hexahedron, join, ribbon, triangles

BODY, SECOND, THIRD = -1, -2, -3
"""Look numbers that an actor's own paint replaces."""


@dataclass
class MeshLooks:
    """Numbers of the looks that do not change from one road user to the next."""

    table: LookTable

    def __post_init__(self) -> None:
        def add(texture: Texture, rgb: tuple[float, float, float], reflectivity: float, gloss: float) -> int:
            return self.table.add(Look(Surface.VEHICLE, texture, rgb, reflectivity, gloss))

        self.glass = add(Texture.GLASS, (0.05, 0.06, 0.07), 0.1, 0.05)
        self.tyre = add(Texture.PLAIN, (0.07, 0.07, 0.07), 0.08, 0.0)
        self.hub = add(Texture.PLAIN, (0.55, 0.56, 0.57), 0.5, 0.1)
        self.dark = add(Texture.PLAIN, (0.12, 0.12, 0.13), 0.12, 0.0)
        self.front_light = add(Texture.PLAIN, (0.95, 0.95, 0.92), 0.9, 0.15)
        self.rear_light = add(Texture.PLAIN, (0.55, 0.03, 0.03), 0.9, 0.08)
        self.plate = add(Texture.PLAIN, (0.90, 0.90, 0.85), 1.0, 0.0)
        self.orange = add(Texture.PLAIN, (0.95, 0.35, 0.08), 0.8, 0.0)
        self.hair = self.table.add(Look(Surface.PEDESTRIAN, Texture.PLAIN, (0.16, 0.11, 0.08), 0.2))
        self.helmet = self.table.add(Look(Surface.PEDESTRIAN, Texture.PLAIN, (0.12, 0.12, 0.13), 0.12))
        self.tank = add(Texture.PLAIN, (0.45, 0.06, 0.05), 0.3, 0.08)


def _taper(
    x: tuple[float, float],
    z: tuple[float, float],
    half_width: tuple[float, float],
    inset: tuple[float, float],
    looks: tuple[int, int, int],
) -> Mesh:
    """A solid from a level rectangle up to a smaller one.

    Args:
        x: rear and front of the lower rectangle; `inset` is how far the upper one is drawn in at either end.
        half_width: of the lower and of the upper rectangle.
        looks: top, ends, sides.
    """
    (x0, x1), (z0, z1), (w0, w1) = x, z, half_width
    top, ends, sides = looks
    a, b = x0 + inset[0], x1 - inset[1]
    return hexahedron(
        [[x0, -w0, z0], [x1, -w0, z0], [x1, w0, z0], [x0, w0, z0]],
        [[a, -w1, z1], [b, -w1, z1], [b, w1, z1], [a, w1, z1]],
        [sides, top, sides, ends, sides, ends],
    )


def _wheels(positions_m: tuple[float, ...], half_width: float, radius: float, looks: MeshLooks) -> Mesh:
    parts = []
    for x in positions_m:
        for side in (-1.0, 1.0):
            outer, inner = side * half_width, side * (half_width - 0.22)
            tyre = frustum((x, inner, radius), (x, outer, radius), (radius, radius), 12, looks.tyre)
            hub = (x, outer, radius), (x, outer + side * 0.01, radius)
            parts += [tyre, frustum(*hub, (0.6 * radius, 0.55 * radius), 8, looks.hub)]
    return join(parts)


def _car(looks: MeshLooks, hood_m: float, boot_m: float, cabin_z: float, belt_z: float) -> Mesh:
    """A car of 4.5 m: tub, bonnet, boot, cabin, wheels, lights."""
    rear, front, w = -2.25, 2.25, 0.9
    cabin_rear, cabin_front = rear + boot_m, front - hood_m
    parts = [
        _taper((rear, front), (0.2, 0.55), (w - 0.05, w), (0.0, 0.0), (BODY, BODY, BODY)),
        _taper((rear, front), (0.55, belt_z - 0.16), (w, w), (0.03, 0.06), (BODY, BODY, BODY)),
        _taper(
            (rear + 0.03, front - 0.06),
            (belt_z - 0.16, belt_z),
            (w, w - 0.06),
            (0.08, hood_m * 0.7),
            (BODY,) * 3,
        ),
        _taper(
            (cabin_rear, cabin_front),
            (belt_z, cabin_z),
            (w - 0.07, w - 0.24),
            (0.45, 0.75),
            (BODY, looks.glass, looks.glass),
        ),
        box((-0.25, -w + 0.09, belt_z), (-0.13, w - 0.09, 0.5 * (belt_z + cabin_z)), BODY),
        box((rear - 0.02, -w + 0.1, 0.25), (rear + 0.1, w - 0.1, 0.45), looks.dark),
        box((front - 0.1, -w + 0.1, 0.25), (front + 0.02, w - 0.1, 0.45), looks.dark),
        box((rear - 0.03, -0.26, 0.6), (rear, 0.26, 0.72), looks.plate),
        _wheels((-1.38, 1.4), w + 0.01, 0.33, looks),
    ]
    for side in (-1.0, 1.0):
        y0, y1 = sorted((side * (w - 0.02), side * (w - 0.35)))
        parts.append(box((front - 0.12, y0, 0.6), (front + 0.01, y1, 0.74), looks.front_light))
        parts.append(box((rear - 0.01, y0, 0.68), (rear + 0.12, y1, 0.84), looks.rear_light))
        y0, y1 = sorted((side * (w - 0.06), side * (w + 0.12)))
        parts.append(box((cabin_front - 0.5, y0, belt_z), (cabin_front - 0.35, y1, belt_z + 0.14), BODY))
    return join(parts)


def _van(looks: MeshLooks) -> Mesh:
    w = 1.0
    parts = [
        _taper((-2.7, 2.7), (0.25, 1.05), (w, w), (0.0, 0.05), (BODY, BODY, BODY)),
        _taper((-2.7, 2.65), (1.05, 2.3), (w, w - 0.12), (0.04, 0.95), (BODY, BODY, BODY)),
        _taper(
            (1.35, 2.6), (1.12, 1.85), (w + 0.005, w - 0.07), (0.0, 0.55), (BODY, looks.glass, looks.glass)
        ),
        _taper((1.0, 2.665), (1.12, 1.85), (w - 0.12, w - 0.16), (0.0, 0.553), (BODY, looks.glass, BODY)),
        box((-2.72, -0.75, 1.25), (-2.68, 0.75, 1.85), looks.glass),
        box((2.6, -w + 0.1, 0.3), (2.72, w - 0.1, 0.55), looks.dark),
        box((-2.74, -0.26, 0.6), (-2.7, 0.26, 0.72), looks.plate),
        _wheels((-1.7, 1.75), w + 0.01, 0.36, looks),
    ]
    for side in (-1.0, 1.0):
        y0, y1 = sorted((side * (w - 0.02), side * (w - 0.3)))
        parts.append(box((2.6, y0, 0.72), (2.71, y1, 0.92), looks.front_light))
        parts.append(box((-2.72, y0, 0.75), (-2.6, y1, 1.15), looks.rear_light))
    return join(parts)


def _truck(looks: MeshLooks) -> Mesh:
    w = 1.2
    parts = [
        box((-3.6, -0.5, 0.55), (3.3, 0.5, 0.85), looks.dark),
        box((-3.6, -w, 0.85), (1.55, w, 3.1), SECOND),
        _taper((1.7, 3.6), (0.45, 1.4), (w - 0.05, w - 0.05), (0.0, 0.0), (BODY, BODY, BODY)),
        _taper((1.7, 3.6), (1.4, 2.3), (w - 0.05, w - 0.15), (0.05, 0.35), (BODY, looks.glass, looks.glass)),
        _taper((1.75, 3.25), (2.3, 2.75), (w - 0.15, w - 0.2), (0.0, 0.5), (BODY, BODY, BODY)),
        box((3.5, -w + 0.15, 0.45), (3.65, w - 0.15, 0.7), looks.dark),
        box((-3.65, -0.9, 0.5), (-3.55, 0.9, 0.62), looks.dark),
        _wheels((-2.4, 2.5), w, 0.48, looks),
    ]
    for side in (-1.0, 1.0):
        y0, y1 = sorted((side * (w - 0.15), side * (w - 0.45)))
        parts.append(box((3.55, y0, 0.8), (3.63, y1, 1.0), looks.front_light))
        parts.append(box((-3.64, y0, 0.62), (-3.55, y1, 0.8), looks.rear_light))
        y0, y1 = sorted((side * (w - 0.05), side * (w + 0.05)))
        parts.append(box((3.2, y0, 1.5), (3.35, y1, 1.9), looks.dark))
    return join(parts)


def _bus(looks: MeshLooks) -> Mesh:
    w = 1.23
    parts = [
        box((-5.2, -w, 0.35), (5.2, w, 1.25), BODY),
        _taper(
            (-5.2, 5.2), (1.25, 2.45), (w - 0.01, w - 0.03), (0.05, 0.12), (BODY, looks.glass, looks.glass)
        ),
        _taper((-5.2, 5.15), (2.45, 3.05), (w, w - 0.08), (0.05, 0.05), (SECOND, BODY, BODY)),
        box((5.12, -0.8, 2.55), (5.2, 0.8, 2.85), looks.orange),
        _wheels((-2.9, 3.0), w + 0.01, 0.48, looks),
    ]
    parts += [
        box((x, -w - 0.002, 1.25), (x + 0.1, w + 0.002, 2.45), BODY) for x in np.arange(-4.2, 4.5, 1.45)
    ]
    for side in (-1.0, 1.0):
        y0, y1 = sorted((side * (w - 0.1), side * (w - 0.4)))
        parts.append(box((5.1, y0, 0.65), (5.22, y1, 0.88), looks.front_light))
        parts.append(box((-5.22, y0, 0.7), (-5.1, y1, 1.05), looks.rear_light))
    return join(parts)


def _ball(centre: tuple[float, float, float], radius: float, look: int) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=1)
    return triangles((sphere.vertices * radius + centre)[sphere.faces], look)


def _rim(x: float, radius: float, thick: float, look: int) -> Mesh:
    """A tyre that one sees through, its axis along y."""
    angle = np.arange(15) * (2 * np.pi / 14)
    circle = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=-1)
    centre, aside = np.array([x, 0.0, radius]), np.array([0.0, thick, 0.0])
    inner, outer = (1.0 - 0.1 - thick) * radius, radius
    rings = [inner * circle - aside, outer * circle - aside, outer * circle + aside, inner * circle + aside]
    bands = [ribbon(centre + a, centre + b, look) for a, b in zip(rings, rings[1:] + rings[:1], strict=True)]
    return join(bands)


def _two_wheeler(looks: MeshLooks, wheel_m: float, thick: float, frame_look: int) -> Mesh:
    """A bicycle or motorcycle with its rider."""
    reach = 0.95 - wheel_m
    parts = []
    for x in (-reach, reach):
        parts.append(_rim(x, wheel_m, thick, looks.tyre))
    seat, bar = 0.9, 1.0
    tube = 0.6 * thick + 0.02
    parts += [
        frustum((-reach, 0, wheel_m), (0.0, 0, 0.45), (tube, tube), 6, frame_look),
        frustum((0.0, 0, 0.45), (reach * 0.75, 0, bar - 0.1), (tube, tube), 6, frame_look),
        frustum((-0.25, 0, seat - 0.05), (reach * 0.75, 0, bar - 0.15), (tube, tube), 6, frame_look),
        frustum((reach, 0, wheel_m), (reach * 0.7, 0, bar), (tube, tube), 6, frame_look),
        box((reach * 0.66, -0.3, bar), (reach * 0.72, 0.3, bar + 0.04), looks.dark),
        box((-0.4, -0.1, seat - 0.05), (-0.1, 0.1, seat + 0.02), looks.dark),
        frustum((-0.25, 0, seat), (0.02, 0, 1.45), (0.15, 0.18), 8, BODY),
        _ball((0.12, 0.0, 1.62), 0.12, THIRD),
    ]
    for side in (-1.0, 1.0):
        knee = (0.12, side * 0.13, 0.72)
        parts += [
            frustum((-0.22, side * 0.09, seat), knee, (0.08, 0.065), 6, SECOND),
            frustum(knee, (0.0, side * 0.12, 0.32), (0.06, 0.05), 6, SECOND),
            frustum(
                (0.0, side * 0.19, 1.38), (reach * 0.69, side * 0.25, bar + 0.03), (0.055, 0.04), 6, BODY
            ),
        ]
    return join(parts)


def _bicycle(looks: MeshLooks) -> Mesh:
    return _two_wheeler(looks, 0.34, 0.02, looks.dark)


def _motorcycle(looks: MeshLooks) -> Mesh:
    bulk = [
        _taper((-0.6, 0.5), (0.35, 0.85), (0.17, 0.12), (0.1, 0.2), (looks.tank, looks.tank, looks.dark)),
        box((0.5, -0.12, 0.85), (0.62, 0.12, 1.05), looks.front_light),
        box((-0.75, -0.1, 0.75), (-0.6, 0.1, 0.85), looks.rear_light),
        _ball((0.12, 0.0, 1.64), 0.15, looks.helmet),
    ]
    return join([_two_wheeler(looks, 0.31, 0.07, looks.dark), *bulk])


def _pedestrian(looks: MeshLooks, swing: float) -> Mesh:
    """Someone 1.75 m tall; `swing` is how far the left foot is ahead of the right one, m."""
    parts = []
    for side in (-1.0, 1.0):
        foot_x = -0.5 * side * swing
        lift = 0.06 if foot_x < 0 else 0.0
        knee = (0.4 * foot_x + 0.06, side * 0.09, 0.48)
        parts += [
            frustum((0.0, side * 0.09, 0.92), knee, (0.09, 0.07), 6, SECOND),
            frustum(knee, (foot_x, side * 0.09, 0.08 + lift), (0.065, 0.05), 6, SECOND),
            box(
                (foot_x - 0.08, side * 0.09 - 0.05, lift),
                (foot_x + 0.18, side * 0.09 + 0.05, lift + 0.09),
                looks.dark,
            ),
            frustum(
                (0.0, side * 0.21, 1.42), (0.35 * side * swing, side * 0.25, 0.9), (0.055, 0.045), 6, BODY
            ),
        ]
    parts += [
        frustum((0, 0, 0.86), (0, 0, 1.47), (0.16, 0.2), 8, BODY),
        frustum((0, 0, 1.45), (0, 0, 1.54), (0.06, 0.055), 6, THIRD),
        _ball((0.01, 0.0, 1.63), 0.115, THIRD),
        _ball((-0.04, 0.0, 1.67), 0.11, looks.hair),
    ]
    return join(parts)


def _cone(looks: MeshLooks) -> Mesh:
    return join(
        [
            box((-0.2, -0.2, 0.0), (0.2, 0.2, 0.04), looks.dark),
            frustum((0, 0, 0.04), (0, 0, 0.75), (0.15, 0.03), 10, looks.orange),
        ]
    )


PEDESTRIAN_BOX = ((-0.3, -0.3, 0.0), (0.3, 0.3, 1.75))
"""What is stretched to the size of a pedestrian, whatever the pose."""

BUILDERS: dict[str, Callable[[MeshLooks], Mesh]] = {
    "sedan": lambda looks: _car(looks, hood_m=1.15, boot_m=0.75, cabin_z=1.45, belt_z=0.95),
    "hatchback": lambda looks: _car(looks, hood_m=1.05, boot_m=0.12, cabin_z=1.5, belt_z=0.96),
    "suv": lambda looks: _car(looks, hood_m=1.1, boot_m=0.1, cabin_z=1.68, belt_z=1.08),
    "van": _van,
    "truck": _truck,
    "bus": _bus,
    "motorcycle": _motorcycle,
    "bicycle": _bicycle,
    "pedestrian_standing": lambda looks: _pedestrian(looks, 0.06),
    "pedestrian_0": lambda looks: _pedestrian(looks, 0.05),
    "pedestrian_1": lambda looks: _pedestrian(looks, 0.42),
    "pedestrian_2": lambda looks: _pedestrian(looks, -0.05),
    "pedestrian_3": lambda looks: _pedestrian(looks, -0.42),
    "cone": _cone,
    "block": lambda looks: box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), SECOND),
}
