"""Shapes of road users.

Each one fits the unit box around the origin, x ahead, and is scaled when it is placed.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int32

from foredrive.scene import Category
from foredrive.scene.actors import ActorState
from foredrive.towns.place.actor_materials import MeshMaterials
from foredrive.towns.place.actor_meshes import DRESSES, OBJECTS, PEOPLE, SHAPES_OF_KIND, VEHICLES
from foredrive.towns.place.assets import Assets, Palette
from foredrive.towns.place.materials import Material, MaterialTable, Surface, Texture
from foredrive.towns.place.mesh import Mesh, join
from foredrive.towns.place.people_meshes import PEDESTRIAN_BOX, POSES
from foredrive.towns.sensing.columns import Intervals
from foredrive.towns.sensing.raycast import TriangleScene
from foredrive.towns.sensing.shading import MISS

PAINTS, SLOTS = 3, 4
"""Number of paints, and of slots that shapes leave open. The last slot is for the rear lights."""
SOLID_CELL_M = 0.15
"""Approximate sampling distance of shapes for occupancy, m."""
_USUAL_SIZE_M = {
    "bus": (11.0, 2.6),
    "coach": (11.0, 2.6),
    "truck": (8.5, 2.6),
    "tanker": (8.5, 2.6),
    "van": (6.0, 2.1),
    "panel_van": (6.0, 2.1),
}
VAN_LENGTH_M, VAN_HEIGHT_M, HIGH_CAR_M = 5.0, 1.9, 1.58
STRIDE_M = 1.4
"""Length of a double step, m."""
WALKING_MPS = 0.3

_SKINS = ((0.90, 0.72, 0.60), (0.78, 0.57, 0.44), (0.55, 0.38, 0.28), (0.40, 0.27, 0.20))


@dataclass(frozen=True)
class Shape:
    """One shape and its part of the library's triangles."""

    scene: TriangleScene
    mesh: Mesh
    first: int
    """Index of its first triangle in the library's triangles."""
    solid: Intervals
    """Solid parts in the unit box."""


@dataclass(frozen=True)
class ShapeLibrary:
    """All shapes of road users."""

    shapes: dict[str, Shape]
    triangles: Mesh
    paints: dict[str, Int32[np.ndarray, "_"]]
    """Materials for painting, by palette."""

    def shape_of(self, actor: ActorState) -> Shape:
        """Return the shape of a road user. A walking person has one of a few poses."""
        if actor.category is Category.PEDESTRIAN:
            return self.shapes[_person(actor)]
        kind = _kind_of(actor)
        if kind not in SHAPES_OF_KIND:
            return self.shapes[kind]
        options = [name for name in SHAPES_OF_KIND[kind] if name in self.shapes]
        return self.shapes[options[actor.style % len(options)]]

    def paint_of(self, actor: ActorState, rear_light: int) -> Int32[np.ndarray, "4"]:
        """Return the materials of the paint slots. `rear_light` is the material of the rear lights."""
        if actor.category is Category.PEDESTRIAN or actor.category in (Category.BICYCLE, Category.MOTORCYCLE):
            palettes = ("clothes", "clothes", "skin")
        elif actor.category is Category.BUS:
            palettes = ("bus", "bus", "bus")
        else:
            palettes = ("car", "cargo", "car")
        # Random numbers follow from the style, so that an actor keeps its paint
        mixed = zip(palettes, _paint_numbers(actor.style), strict=True)
        chosen = [self.paints[p][int(u * len(self.paints[p]))] for p, u in mixed]
        return np.array([*chosen, rear_light], dtype=np.int32)


@lru_cache(maxsize=4096)
def _paint_numbers(style: int) -> tuple[float, ...]:
    """Return uniform random numbers, one for each paint slot."""
    return tuple(np.random.default_rng(style).random(PAINTS).tolist())


def make_shape_library(table: MaterialTable, assets: Assets) -> ShapeLibrary:
    """Build every shape of the assets once."""
    materials = MeshMaterials(table)
    vehicles = {name: VEHICLES[name] for name in assets.vehicles}
    shapes, first = {}, 0
    for name, build in {**vehicles, **PEOPLE, **OBJECTS}.items():
        mesh = _into_unit_box(build(materials), PEDESTRIAN_BOX if name in PEOPLE else None)
        scene = TriangleScene(mesh)
        shapes[name] = Shape(scene, mesh, first, _solid(scene, _USUAL_SIZE_M.get(name, (5.0, 2.0))))
        first += len(mesh.material)

    def paints(colours: Palette, gloss: float) -> Int32[np.ndarray, "_"]:
        surface = Surface.VEHICLE if gloss > 0.0 else Surface.PEDESTRIAN
        numbers = [
            table.add(Material(surface, Texture.PLAIN, c, 0.15 + 0.5 * float(np.mean(c)), gloss))
            for c in colours
        ]
        return np.array(numbers, dtype=np.int32)

    return ShapeLibrary(
        shapes=shapes,
        triangles=join([shape.mesh for shape in shapes.values()]),
        paints={
            "car": paints(assets.car_paints, 0.07),
            "cargo": paints(assets.cargo_paints, 0.02),
            "bus": paints(assets.bus_paints, 0.05),
            "clothes": paints(assets.clothes, 0.0),
            "skin": paints(_SKINS, 0.0),
        },
    )


def _person(actor: ActorState) -> str:
    """Return the name of dress and pose. The legs follow the distance walked along the heading."""
    dress = DRESSES[actor.style % len(DRESSES)]
    if np.linalg.norm(actor.velocity_mps) < WALKING_MPS:
        return f"{dress}_standing"
    # Phase of the step by the distance along the heading: feet do not slide
    along = actor.centre_m[0] * np.cos(actor.yaw) + actor.centre_m[1] * np.sin(actor.yaw)
    return f"{dress}_{int(along / STRIDE_M * POSES) % POSES}"


def _kind_of(actor: ActorState) -> str:
    """Return the kind of shape for a road user that is not a pedestrian."""
    if actor.category is Category.CAR:
        length, _, height = actor.size_lwh
        if length > VAN_LENGTH_M and height > VAN_HEIGHT_M:
            return "van"
        return "high_car" if height > HIGH_CAR_M else "low_car"
    return _KIND_OF_CATEGORY.get(actor.category, "block")


_KIND_OF_CATEGORY = {
    Category.TRUCK: "truck",
    Category.BUS: "bus",
    Category.MOTORCYCLE: "motorcycle",
    Category.BICYCLE: "bicycle",
    Category.TRAFFIC_CONE: "cone",
}


def unit_to_world(actor: ActorState) -> Float[np.ndarray, "4 4"]:
    """Return the affine map from the unit box to an actor's box."""
    cos, sin = np.cos(actor.yaw), np.sin(actor.yaw)
    up, ahead = np.sin(actor.pitch), np.cos(actor.pitch)
    yaw = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    # Positive pitch lowers the nose: x ahead tilts towards -z
    pitch = np.array([[ahead, 0.0, up], [0.0, 1.0, 0.0], [-up, 0.0, ahead]])
    T = np.eye(4)
    # Scale to the box first, then pitch, then yaw
    T[:3, :3] = yaw @ pitch * actor.size_lwh
    T[:3, 3] = actor.centre_m
    return T


def _solid(scene: TriangleScene, size_m: tuple[float, float]) -> Intervals:
    """Return the solid parts in the unit box, from the lowest to the highest face.

    `size_m` is the approximate size of the object and sets the sampling.
    """
    # A grid of vertical lines through the unit box
    counts = [int(np.ceil(edge / SOLID_CELL_M)) for edge in size_m]
    x, y = (a.ravel() for a in np.meshgrid(*((np.arange(n) + 0.5) / n - 0.5 for n in counts)))
    ends = []
    # Cast from above and from below: the first hits are the upper and the lower end
    for side in (1.0, -1.0):
        origin = np.column_stack([x, y, np.full_like(x, side)]).astype(np.float32)
        direction = np.tile(np.array([0.0, 0.0, -side], np.float32), (len(x), 1))
        hits = scene.cast(origin, direction)
        # The unit box reaches from -½ to ½; rays begin outside of it
        ends.append(side - side * hits.t)
    met = hits.triangle != MISS
    x, y, high, low = (a[met].astype(np.float32) for a in (x, y, *ends))
    return Intervals(x, y, low, high, np.full(len(x), int(Surface.VEHICLE)))


def _into_unit_box(
    mesh: Mesh, bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None
) -> Mesh:
    """Map `bounds`, by default the bounds of the mesh, to the unit box around the origin."""
    corners = mesh.xyz.reshape(-1, 3)
    low, high = np.array(bounds) if bounds else (corners.min(0), corners.max(0))
    xyz = ((mesh.xyz - 0.5 * (low + high)) / (high - low)).clip(-0.5, 0.5)
    return Mesh(np.ascontiguousarray(xyz, dtype=np.float32), np.zeros_like(mesh.uvw), mesh.material)
