"""Shapes of road users by name."""

from collections.abc import Callable
from functools import partial

from foredrive.towns.place import car_meshes, large_meshes, people_meshes
from foredrive.towns.place.actor_materials import SECOND, MeshMaterials
from foredrive.towns.place.mesh import Mesh, box, frustum, join

SHAPES_OF_KIND = {
    "low_car": ("sedan", "hatchback", "estate", "coupe", "compact"),
    "high_car": ("suv", "pickup", "crossover", "people_carrier"),
    "van": ("van", "panel_van"),
    "truck": ("truck", "tanker"),
    "bus": ("bus", "coach"),
    "motorcycle": ("motorcycle", "scooter"),
    "bicycle": ("bicycle", "city_bike"),
}
"""Shapes that can represent each kind of vehicle."""
DRESSES = ("jacket", "coat", "backpack")


def _cone(materials: MeshMaterials) -> Mesh:
    return join(
        [
            box((-0.2, -0.2, 0.0), (0.2, 0.2, 0.04), materials.dark),
            frustum((0, 0, 0.04), (0, 0, 0.35), (0.15, 0.1), 10, materials.orange),
            frustum((0, 0, 0.35), (0, 0, 0.5), (0.1, 0.075), 10, materials.plate),
            frustum((0, 0, 0.5), (0, 0, 0.75), (0.075, 0.03), 10, materials.orange),
        ]
    )


def _block(materials: MeshMaterials) -> Mesh:
    return box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), SECOND)


VEHICLES: dict[str, Callable[[MeshMaterials], Mesh]] = {
    **{name: partial(car_meshes.car, form=form) for name, form in car_meshes.FORMS.items()},
    "van": large_meshes.van,
    "panel_van": large_meshes.panel_van,
    "truck": large_meshes.truck,
    "tanker": large_meshes.tanker,
    "bus": large_meshes.bus,
    "coach": large_meshes.coach,
    "motorcycle": people_meshes.motorcycle,
    "scooter": people_meshes.scooter,
    "bicycle": people_meshes.bicycle,
    "city_bike": people_meshes.city_bike,
}
PEOPLE: dict[str, Callable[[MeshMaterials], Mesh]] = {
    **{f"{dress}_standing": partial(people_meshes.pedestrian, phase=None, dress=dress) for dress in DRESSES},
    **{
        f"{dress}_{pose}": partial(people_meshes.pedestrian, phase=pose / people_meshes.POSES, dress=dress)
        for dress in DRESSES
        for pose in range(people_meshes.POSES)
    },
}
OBJECTS: dict[str, Callable[[MeshMaterials], Mesh]] = {"cone": _cone, "block": _block}
