"""Meshes of people on foot and on two wheels. Units are metres; x points ahead; people stand on z = 0."""

import math

import numpy as np
import trimesh

from foredrive.towns.place.actor_materials import BODY, SECOND, THIRD, MeshMaterials
from foredrive.towns.place.large_meshes import taper
from foredrive.towns.place.mesh import Mesh, box, frustum, join, ribbon, triangles

POSES = 8
"""Number of poses in one double step."""
PEDESTRIAN_BOX = ((-0.36, -0.3, 0.0), (0.36, 0.3, 1.75))
"""Box that is scaled to the size of a pedestrian in any pose, m."""
HIP_M, THIGH_M, SHANK_M = 0.92, 0.44, 0.42
HIP_SWING_RAD, KNEE_BEND_RAD, ARM_SWING_RAD = 0.42, 0.95, 0.45


def _ball(centre: tuple[float, float, float], radius: float, material: int) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=1)
    return triangles((sphere.vertices * radius + centre)[sphere.faces], material)


def pedestrian(mats: MeshMaterials, phase: float | None, dress: str) -> Mesh:
    """Build a pedestrian, 1.75 m tall.

    Args:
        phase: phase of the double step, 0 to 1, which begins with the left foot moving forward. None:
            standing.
        dress: "jacket", "coat" or "backpack".
    """
    legs, feet = [], []
    coat = dress == "coat"
    for side, shift in ((1.0, 0.0), (-1.0, 0.5)):
        # Standing: straight legs with a slight bend of the knee
        hip, knee = 0.0, 0.04
        if phase is not None:
            # Sine for the hip; the other leg is half a double step behind
            turn = 2.0 * math.pi * (phase + shift)
            hip = HIP_SWING_RAD * math.sin(turn) * (0.8 if coat else 1.0)
            knee += KNEE_BEND_RAD * max(0.0, math.cos(turn)) ** 1.5  # bent while the leg swings forward
        y = side * 0.09
        # Forward kinematics in the side view: hip, knee, foot
        knee_x, knee_z = THIGH_M * math.sin(hip), HIP_M - THIGH_M * math.cos(hip)
        foot_x, foot_z = knee_x + SHANK_M * math.sin(hip - knee), knee_z - SHANK_M * math.cos(hip - knee)
        foot_z -= 0.06
        feet.append(foot_z)
        legs += [
            frustum((0.0, y, HIP_M), (knee_x, y, knee_z), (0.09, 0.065), 6, SECOND),
            frustum((knee_x, y, knee_z), (foot_x, y, foot_z + 0.06), (0.065, 0.045), 6, SECOND),
            box((foot_x - 0.07, y - 0.045, foot_z), (foot_x + 0.16, y + 0.045, foot_z + 0.08), mats.dark),
        ]
    # Put the lower foot on the ground
    low = min(feet)
    parts = [*legs, *_arms(phase)]
    # Trunk, shoulders, neck and head
    parts += [
        frustum((0, 0, 0.86), (0, 0, 1.2), (0.155, 0.15), 8, SECOND if dress == "jacket" else BODY),
        frustum((0, 0, 1.02), (0, 0, 1.4), (0.16, 0.2), 8, BODY),
        frustum((0, 0, 1.4), (0, 0, 1.49), (0.2, 0.09), 8, BODY),
        frustum((0, 0, 1.45), (0, 0, 1.54), (0.06, 0.055), 6, THIRD),
        _ball((0.01, 0.0, 1.63), 0.115, THIRD),
        _ball((-0.04, 0.0, 1.67), 0.11, mats.hair),
    ]
    if coat:
        parts.append(frustum((0, 0, 0.5), (0, 0, 1.02), (0.24, 0.16), 8, BODY))
        parts.append(_ball((-0.06, 0.0, 1.58), 0.12, mats.hair))
    if dress == "backpack":
        parts.append(box((-0.34, -0.15, 1.0), (-0.13, 0.15, 1.42), mats.tank))
    mesh = join(parts)
    return Mesh((mesh.xyz - np.array([0.0, 0.0, low])).astype(np.float32), mesh.uvw, mesh.material)


def _arms(phase: float | None) -> list[Mesh]:
    parts = []
    # Arms swing against the legs of their side
    for side, shift in ((1.0, 0.5), (-1.0, 0.0)):
        swing = 0.0 if phase is None else ARM_SWING_RAD * math.sin(2.0 * math.pi * (phase + shift))
        bend = 0.15 + (0.0 if phase is None else 0.3 + 0.3 * swing)
        elbow = (0.29 * math.sin(swing), side * 0.25, 1.41 - 0.29 * math.cos(swing))
        hand = (
            elbow[0] + 0.26 * math.sin(swing + bend),
            side * 0.25,
            elbow[2] - 0.26 * math.cos(swing + bend),
        )
        parts += [
            frustum((0.0, side * 0.2, 1.42), elbow, (0.06, 0.05), 6, BODY),
            frustum(elbow, hand, (0.05, 0.04), 6, BODY),
            _hand(hand),
        ]
    return parts


def _hand(xyz: tuple[float, float, float]) -> Mesh:
    x, y, z = xyz
    return box((x - 0.035, y - 0.025, z - 0.1), (x + 0.035, y + 0.025, z + 0.01), THIRD)


def _rim(x: float, radius: float, thick: float, material: int) -> Mesh:
    """Build an open tyre whose axis is along y."""
    angle = np.arange(15) * (2 * np.pi / 14)
    circle = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=-1)
    # Four circles around the tyre: inner and outer, on both sides
    centre, aside = np.array([x, 0.0, radius]), np.array([0.0, thick, 0.0])
    inner, outer = (1.0 - 0.1 - thick) * radius, radius
    # Bands between neighbouring circles close the tyre
    rings = [inner * circle - aside, outer * circle - aside, outer * circle + aside, inner * circle + aside]
    bands = [
        ribbon(centre + a, centre + b, material) for a, b in zip(rings, rings[1:] + rings[:1], strict=True)
    ]
    return join(bands)


def _two_wheeler(mats: MeshMaterials, wheel_m: float, thick: float, frame_material: int) -> Mesh:
    """Build a bicycle or motorcycle with its rider."""
    reach = 0.95 - wheel_m
    parts = []
    for x in (-reach, reach):
        parts.append(_rim(x, wheel_m, thick, mats.tyre))
    seat, bar = 0.9, 1.0
    tube = 0.6 * thick + 0.02
    # Frame, bar and saddle, then the rider's trunk and head
    parts += [
        frustum((-reach, 0, wheel_m), (0.0, 0, 0.45), (tube, tube), 6, frame_material),
        frustum((0.0, 0, 0.45), (reach * 0.75, 0, bar - 0.1), (tube, tube), 6, frame_material),
        frustum((-0.25, 0, seat - 0.05), (reach * 0.75, 0, bar - 0.15), (tube, tube), 6, frame_material),
        frustum((reach, 0, wheel_m), (reach * 0.7, 0, bar), (tube, tube), 6, frame_material),
        box((reach * 0.66, -0.3, bar), (reach * 0.72, 0.3, bar + 0.04), mats.dark),
        box((-0.4, -0.1, seat - 0.05), (-0.1, 0.1, seat + 0.02), mats.dark),
        frustum((-0.25, 0, seat), (0.02, 0, 1.45), (0.15, 0.18), 8, BODY),
        _ball((0.12, 0.0, 1.62), 0.12, THIRD),
    ]
    # Legs to the pedals, arms to the bar
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


def bicycle(mats: MeshMaterials) -> Mesh:
    """Build a bicycle with a diamond frame."""
    return _two_wheeler(mats, 0.34, 0.02, mats.dark)


def motorcycle(mats: MeshMaterials) -> Mesh:
    """Build a motorcycle and a rider with a helmet."""
    bulk = [
        taper((-0.6, 0.5), (0.35, 0.85), (0.17, 0.12), (0.1, 0.2), (mats.tank, mats.tank, mats.dark)),
        box((0.5, -0.12, 0.85), (0.62, 0.12, 1.05), mats.front_light),
        box((-0.75, -0.1, 0.75), (-0.6, 0.1, 0.85), mats.rear_light),
        _ball((0.12, 0.0, 1.64), 0.15, mats.helmet),
    ]
    return join([_two_wheeler(mats, 0.31, 0.07, mats.dark), *bulk])


def city_bike(mats: MeshMaterials) -> Mesh:
    """Build a bicycle with mudguards, a basket and a rear rack."""
    reach = 0.95 - 0.34
    extra = [
        box((reach + 0.02, -0.17, 0.78), (reach + 0.3, 0.17, 1.0), mats.hub),
        box((-reach - 0.3, -0.07, 0.72), (-reach + 0.25, 0.07, 0.75), mats.dark),
        box((-reach - 0.32, -0.03, 0.55), (-reach - 0.28, 0.03, 0.65), mats.rear_light),
    ]
    return join([_two_wheeler(mats, 0.34, 0.025, mats.tank), *extra])


def scooter(mats: MeshMaterials) -> Mesh:
    """Build a motor scooter with a leg shield and a top case."""
    extra = [
        taper((-0.85, -0.05), (0.3, 0.85), (0.2, 0.15), (0.1, 0.1), (mats.dark, mats.tank, mats.tank)),
        taper((0.4, 0.6), (0.25, 1.0), (0.22, 0.16), (0.02, 0.1), (mats.tank, mats.tank, mats.tank)),
        box((-0.1, -0.16, 0.25), (0.45, 0.16, 0.33), mats.dark),
        box((0.5, -0.1, 0.85), (0.6, 0.1, 1.0), mats.front_light),
        box((-0.98, -0.18, 0.85), (-0.6, 0.18, 1.15), mats.dark),
        box((-0.92, -0.1, 0.68), (-0.84, 0.1, 0.78), mats.rear_light),
        _ball((0.12, 0.0, 1.64), 0.15, mats.helmet),
    ]
    return join([_two_wheeler(mats, 0.25, 0.09, mats.dark), *extra])
