"""Materials of objects for a camera and a lidar: surfaces, textures and the table of materials."""

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64


class Surface(enum.IntEnum):
    """The class of a static object: the semantics of the town."""

    ROAD = 0
    SIDEWALK = 1
    TERRAIN = 2
    BUILDING = 3
    VEGETATION = 4
    POLE = 5
    SIGN = 6
    STRUCTURE = 7
    """Bridges, walls, barriers."""
    VEHICLE = 8
    PEDESTRIAN = 9
    HIDDEN = 10
    """Ground under the road, which only a ray through a crack reaches."""
    SIGNAL = 11
    """Heads of traffic lights."""


class Texture(enum.IntEnum):
    """Procedural patterns. `u, v, w` are the interpolated corner coordinates, `p` its parameters."""

    PLAIN = 0
    """p0: strength of the mottling."""
    ROAD = 1
    """Asphalt with lines. u, v: distance from the left and right border; w: distance along, all in m.
    p0..p2: `LinePattern`, colour (0 white, 1 yellow) and width of the left line; p3..p5: the same of the
    right line."""
    SLABS = 2
    """u, v: distance from the left and right edge, where a kerb stone lies, m. p0: edge of the slabs, m."""
    GRASS = 3
    FACADE = 4
    """u: distance from the wall's left end; v: height above the ground; w: distance from its right end, m.
    p0: storey height; p1: bay width; p2: window width as a fraction of the bay; p3: window height as a
    fraction of the storey; p4: height of the ground floor; p5: `WallKind`; p6: `WindowKind`; p7:
    `GroundFloor`; p8: row of `facades.ACCENT_RGB` for doors, shutters and signs."""
    TILES = 5
    """u: distance along the eaves; v: distance up the slope, m."""
    FOLIAGE = 6
    STRIPES = 7
    """u: distance across the stripes, m. p0: period; p1: width of a stripe."""
    GLASS = 8
    GLOW = 9
    """A surface that emits light."""
    FIELD = 10
    """Crops, with grass outside. u: distance across the rows; v: along them; w: from the border inwards, m.
    p0: distance of the rows; p1: their width; p2..p4: linear colour between them."""


class LinePattern(enum.IntEnum):
    """The lines that are painted along the border of a lane."""

    NONE = 0
    SOLID = 1
    BROKEN = 2
    DOUBLE_SOLID = 3
    DOUBLE_BROKEN = 4


class WallKind(enum.IntEnum):
    """The material of a façade."""

    PLASTER = 0
    BRICK = 1
    STONE = 2
    """Large slabs."""
    SHEET = 3
    """Corrugated metal."""
    BOARDS = 4


class WindowKind(enum.IntEnum):
    """The windows of a façade."""

    CASEMENT = 0
    """Two leaves above a sill."""
    TALL = 1
    """Windows down to the floor, behind a rail."""
    RIBBON = 2
    """Windows side by side along the whole storey."""
    CURTAIN = 3
    """A wall of glass."""
    HALL = 4
    """A band below the eaves."""
    SHUTTERED = 5
    GRID = 6
    """Many small panes."""
    SLIT = 7
    """Two narrow windows in each bay."""


class GroundFloor(enum.IntEnum):
    """The ground floor of a façade."""

    DOORS = 0
    SHOPS = 1
    GATES = 2
    """Roller doors of a hall."""


PARAMETERS = 9
GRASS_RGB = (0.40, 0.43, 0.26)
"""Colour of the land."""
ASPHALT_RGB = (0.36, 0.36, 0.365)
RETROREFLECTIVE = 3.0
"""Reflectivity of road signs and number plates for a viewer at the light source."""


@dataclass(frozen=True)
class Material:
    """The appearance of one part of a mesh."""

    surface: Surface
    texture: Texture
    rgb: tuple[float, float, float]
    """Reflectance as sRGB would show it under white light, 0 to 1."""
    reflectivity: float
    """Reflectivity for the lidar's infra-red light, 0 to 1; higher for retroreflective surfaces."""
    gloss: float = 0.0
    """Share of the sky that is mirrored at perpendicular incidence, 0 to 1."""
    params: tuple[float, ...] = ()


@dataclass
class MaterialTable:
    """Materials by number. Equal materials have the same number."""

    materials: list[Material] = field(default_factory=list)
    numbers: dict[Material, int] = field(default_factory=dict)

    def add(self, material: Material) -> int:
        """Return the number of a material and add the material if it is new."""
        if material not in self.numbers:
            self.numbers[material] = len(self.materials)
            self.materials.append(material)
        return self.numbers[material]

    def arrays(self) -> "MaterialArrays":
        """Return the table as arrays, for compiled functions."""
        params = [
            (*material.params, *[0.0] * (PARAMETERS - len(material.params))) for material in self.materials
        ]
        return MaterialArrays(
            surface=np.array([material.surface for material in self.materials], dtype=np.int64),
            texture=np.array([material.texture for material in self.materials], dtype=np.int64),
            albedo=srgb_to_linear([material.rgb for material in self.materials]),
            reflectivity=np.array([material.reflectivity for material in self.materials], dtype=np.float32),
            gloss=np.array([material.gloss for material in self.materials], dtype=np.float32),
            params=np.array(params, dtype=np.float32),
        )


class MaterialArrays(NamedTuple):
    """L materials as one array per property."""

    surface: Int64[np.ndarray, "L"]
    texture: Int64[np.ndarray, "L"]
    albedo: Float32[np.ndarray, "L 3"]
    """Linear colour."""
    reflectivity: Float32[np.ndarray, "L"]
    gloss: Float32[np.ndarray, "L"]
    params: Float32[np.ndarray, "L P"]


def srgb_to_linear(rgb: Sequence[Sequence[float]]) -> Float32[np.ndarray, "n 3"]:
    """Decode sRGB values in 0..1 (IEC 61966-2-1)."""
    encoded = np.asarray(rgb, dtype=np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )
