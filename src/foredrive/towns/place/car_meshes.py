"""Meshes of cars, lofted through cross-sections. Units are metres; x points ahead; cars stand on z = 0."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foredrive.towns.place.actor_materials import BODY, MeshMaterials
from foredrive.towns.place.mesh import Mesh, box, frustum, join, quads, triangles

HALF_WIDTH_M = 0.9
PILLAR_M = 0.09
_END_WIDTH = ((0.0, 0.84), (0.12, 0.94), (0.35, 1.0), (3.6, 1.0), (4.3, 0.95), (4.42, 0.84), (4.5, 0.7))
"""Half width as a fraction of the maximum, by the distance (m) from the rear of a car of 4.5 m."""


@dataclass(frozen=True)
class CarForm:
    """The side view of a car of 4.5 m with its front at x = 2.25."""

    deck: tuple[tuple[float, float], ...]
    """x, z of the upper edge of the body from the rear to the front, m: boot, belt, bonnet."""
    cabin: tuple[float, float, float, float]
    """x of the lower edge of the rear window, the roof's rear end, its front end and the lower edge of the
    windscreen, m."""
    roof_z: float
    clearance_m: float = 0.2
    cladding: bool = False
    """Whether there is dark plastic around the sills, as on cars for rough roads."""
    bed: bool = False
    """Whether there is a load bed behind the cabin."""


FORMS = {
    "sedan": CarForm(
        ((-2.25, 0.8), (-2.15, 0.95), (-1.6, 1.0), (0.9, 0.95), (1.95, 0.82), (2.25, 0.62)),
        (-1.7, -0.95, 0.2, 1.0),
        1.45,
    ),
    "hatchback": CarForm(
        ((-2.25, 0.75), (-2.2, 0.95), (-1.6, 1.0), (1.05, 0.97), (2.0, 0.84), (2.25, 0.62)),
        (-2.17, -1.75, 0.3, 1.15),
        1.5,
    ),
    "estate": CarForm(
        ((-2.25, 0.8), (-2.2, 0.97), (-1.6, 0.99), (0.95, 0.95), (1.95, 0.82), (2.25, 0.62)),
        (-2.2, -1.95, 0.2, 1.0),
        1.48,
    ),
    "suv": CarForm(
        ((-2.25, 0.9), (-2.2, 1.08), (-1.6, 1.1), (1.0, 1.06), (2.05, 0.98), (2.25, 0.72)),
        (-2.18, -1.85, 0.3, 1.05),
        1.7,
        clearance_m=0.28,
        cladding=True,
    ),
    "pickup": CarForm(
        ((-2.25, 1.0), (-2.24, 1.06), (-0.85, 1.06), (1.0, 1.06), (2.05, 1.0), (2.25, 0.74)),
        (-0.8, -0.7, 0.4, 1.0),
        1.75,
        clearance_m=0.32,
        bed=True,
    ),
    "coupe": CarForm(
        ((-2.25, 0.75), (-2.15, 0.95), (-1.7, 0.97), (0.6, 0.9), (1.9, 0.72), (2.25, 0.52)),
        (-1.9, -0.65, -0.1, 0.85),
        1.32,
    ),
    "compact": CarForm(
        ((-2.25, 0.75), (-2.22, 1.05), (-1.6, 1.06), (1.25, 1.02), (2.05, 0.9), (2.25, 0.66)),
        (-2.22, -2.0, 0.25, 1.5),
        1.62,
    ),
    "crossover": CarForm(
        ((-2.25, 0.85), (-2.15, 1.12), (-1.7, 1.12), (0.9, 1.02), (2.0, 0.9), (2.25, 0.68)),
        (-2.1, -1.1, 0.1, 1.05),
        1.62,
        clearance_m=0.3,
        cladding=True,
    ),
    "people_carrier": CarForm(
        ((-2.25, 0.8), (-2.22, 1.0), (-1.6, 1.02), (1.35, 1.0), (2.05, 0.86), (2.25, 0.62)),
        (-2.22, -2.1, 0.55, 1.6),
        1.75,
    ),
}


def loft(
    x: Float[np.ndarray, "S"],
    rings: Float[np.ndarray, "S K 2"],
    mats: Sequence[Sequence[int]],
    ends: tuple[int, int],
) -> Mesh:
    """Build a closed solid through S cross-sections.

    Each cross-section has K points (y, z), counter-clockwise seen from ahead.

    Args:
        mats: materials of the faces, segment by segment from the rear, then around the ring from its first
            point.
        ends: materials of the rear and the front face.
    """
    # Sections as 3-D points, and the next point around the ring
    xyz = np.concatenate([np.broadcast_to(x[:, None, None], (*rings.shape[:2], 1)), rings], axis=-1)
    after = np.roll(xyz, -1, axis=1)
    # One quad between each pair of neighbouring points of neighbouring sections
    corners = np.stack([xyz[:-1], after[:-1], after[1:], xyz[1:]], axis=2).reshape(-1, 4, 3)
    sides = quads(corners, 0)
    # Each quad has two triangles
    material = np.repeat(np.array(mats, dtype=np.int32).ravel(), 2)
    fans = []
    # Close both ends with fans about their centres; the rear one is reversed to face backwards
    for end, ring in zip(ends, (xyz[0, ::-1], xyz[-1]), strict=True):
        hub = np.broadcast_to(ring.mean(axis=0), ring.shape)
        fans.append(triangles(np.stack([hub, ring, np.roll(ring, -1, axis=0)], axis=1), end))
    return join([Mesh(sides.xyz, sides.uvw, material), *fans])


def wheels(
    positions_m: Sequence[float], half_width: float, radius: float, mats: MeshMaterials, arches: int | None
) -> Mesh:
    """Build pairs of wheels. With the material `arches`, add wheel arches on a body of this half width."""
    parts = []
    for x in positions_m:
        for side in (-1.0, 1.0):
            outer, inner = side * (half_width + 0.012), side * (half_width - 0.22)
            parts.append(frustum((x, inner, radius), (x, outer, radius), (radius, radius), 12, mats.tyre))
            hub = (x, outer, radius), (x, outer + side * 0.012, radius)
            parts.append(frustum(*hub, (0.62 * radius, 0.5 * radius), 7, mats.hub))
            # Half discs over the wheels, just outside of the body
            if arches is not None:
                angle = np.linspace(0.0, np.pi, 9)
                rim = np.stack([x + 1.2 * radius * np.cos(angle), radius + 1.2 * radius * np.sin(angle)], -1)
                y = np.full((8, 1), side * (half_width + 0.004))
                first, second = (np.insert(r, [1], y, axis=1) for r in (rim[:-1], rim[1:]))
                hub_xyz = np.broadcast_to([x, side * (half_width + 0.004), radius], first.shape)
                # The order of the corners makes the disc face outwards on either side
                order = (hub_xyz, second, first) if side > 0 else (hub_xyz, first, second)
                parts.append(triangles(np.stack(order, axis=1), arches))
    return join(parts)


def car(mats: MeshMaterials, form: CarForm) -> Mesh:
    """Build a car with body, cabin, wheels, lights, bumpers, plates and mirrors."""
    w, rear, front = HALF_WIDTH_M, -2.25, 2.25
    belt_z = float(np.interp(form.cabin[3], *np.array(form.deck).T))
    parts = [
        _body(mats, form),
        _cabin(mats, form),
        wheels((-1.38, 1.4), w - 0.01, 0.33, mats, mats.dark),
        box((rear - 0.03, -0.7 * w, 0.3), (rear + 0.1, 0.7 * w, 0.48), mats.dark),
        box((front - 0.2, -0.62 * w, 0.28), (front + 0.02, 0.62 * w, 0.5), mats.dark),
        box((rear - 0.05, -0.26, 0.62), (rear + 0.02, 0.26, 0.73), mats.plate),
        box((front - 0.05, -0.26, 0.36), (front + 0.04, 0.26, 0.47), mats.plate),
    ]
    # Lights and mirrors on both sides
    nose_z, tail_z = form.deck[-1][1], form.deck[0][1]
    for side in (-1.0, 1.0):
        y0, y1 = sorted((side * 0.72 * w, side * 0.46 * w))
        parts.append(
            box((front - 0.16, y0, nose_z - 0.1), (front + 0.005, y1, nose_z + 0.03), mats.front_light)
        )
        y0, y1 = sorted((side * 0.87 * w, side * 0.62 * w))
        parts.append(box((rear - 0.02, y0, tail_z - 0.14), (rear + 0.1, y1, tail_z + 0.02), mats.rear_light))
        y0, y1 = sorted((side * (w - 0.06), side * (w + 0.1)))
        mirror_x = form.cabin[3] - 0.4
        parts.append(box((mirror_x - 0.1, y0, belt_z), (mirror_x + 0.05, y1, belt_z + 0.13), BODY))
    if form.bed:
        bed = (rear + 0.08, -w + 0.12, 1.0), (form.cabin[0] - 0.05, w - 0.12, 1.075)
        parts.append(box(*bed, mats.dark))
    return join(parts)


def _body(mats: MeshMaterials, form: CarForm) -> Mesh:
    """Build the body, from the sills up to the belt, the boot and the bonnet."""
    from_rear, share = np.array(_END_WIDTH).T
    deck_x, deck_z = np.array(form.deck).T
    # Sections wherever the outline or the deck has a corner
    x = np.unique(np.concatenate([from_rear - 2.25, deck_x]).round(3))
    half = HALF_WIDTH_M * np.interp(x, from_rear - 2.25, share)
    top = np.interp(x, deck_x, deck_z)
    # The underside rises at both ends
    low = form.clearance_m + 0.1 * (np.abs(x) > 2.1)
    shoulder, sill = top - 0.09, low + 0.16
    # Right half of the ring from below to above, then its mirror image
    right = [(0.9 * half, low), (half, sill), (half, shoulder), (half - 0.09, top)]
    ring = [*right, *((-y, z) for y, z in reversed(right))]
    rings = np.stack([np.stack(np.broadcast_arrays(y, z), axis=-1) for y, z in ring], axis=1)
    # One material for each face around the ring
    edge = mats.dark if form.cladding else BODY
    around = [edge, BODY, BODY, BODY, BODY, BODY, edge, mats.dark]
    return loft(x, rings, [around] * (len(x) - 1), (BODY, BODY))


def _cabin(mats: MeshMaterials, form: CarForm) -> Mesh:
    """Build the cabin: windows between pillars, under a roof."""
    a, b, c, d = form.cabin
    middle = 0.5 * (b + c) - 0.1
    # Sections at the pillars: windscreen and rear window lie between the first and last two
    x = np.array([a, b, b + PILLAR_M, middle, middle + PILLAR_M, c - 0.02, c, d])
    deck_x, deck_z = np.array(form.deck).T
    belt = np.interp(x, deck_x, deck_z) - 0.03
    # The roof's ends fall to the belt at both ends, which gives the sloping windows
    top = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0]) * (form.roof_z - belt - 0.04) + belt + 0.02
    # Windows lean inwards in proportion to their height
    lean = (top - belt) / (form.roof_z - 0.95)
    foot = np.full_like(x, HALF_WIDTH_M - 0.09)
    eave = foot - 0.16 * lean
    right = [(foot, belt), (eave, top), (eave - 0.08, top + 0.035 * lean.round())]
    ring = [*right, *((-y, z) for y, z in reversed(right))]
    rings = np.stack([np.stack([y, z], axis=-1) for y, z in ring], axis=1)
    pane, post = mats.glass, BODY
    sides = [pane, post, pane, post, pane, post, pane]
    roofs = [pane, post, post, post, post, post, pane]
    around = [[s, post, r, post, s, mats.dark] for s, r in zip(sides, roofs, strict=True)]
    return loft(x, rings, around, (post, post))
