"""Rectangular plots for buildings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

from foredrive.towns.place.mesh import Mesh, Vector, box, walls

FOUNDATION_M = 1.5


@dataclass(frozen=True)
class Plot:
    """A rectangle for a building.

    Local x runs along the front with the street behind it; y points into the plot.
    """

    corner: Float[np.ndarray, "2"]
    """Start of the front, the origin of the local coordinates. The plot lies to the left of `along`."""
    along: Float[np.ndarray, "2"]
    width_m: float
    depth_m: float

    @property
    def into(self) -> Float[np.ndarray, "2"]:
        """Return the unit direction away from the street."""
        return np.array([-self.along[1], self.along[0]])

    def world(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Map local points to the town."""
        return self.corner + xy[..., :1] * self.along + xy[..., 1:] * self.into

    def polygon(self, grow_m: float = 0.0) -> shapely.Polygon:
        """Return the rectangle in the town, enlarged on all sides."""
        w, d, g = self.width_m, self.depth_m, grow_m
        return shapely.Polygon(self.world(np.array([[-g, -g], [w + g, -g], [w + g, d + g], [-g, d + g]])))

    def placed(self, mesh: Mesh) -> Mesh:
        """Move a mesh from local coordinates to the town. Its z does not change."""
        T = np.eye(4)
        T[:2, 0], T[:2, 1], T[:2, 3] = self.along, self.into, self.corner
        return mesh.transformed(T)

    def walls(self, outline: Sequence[Vector], base: float, top: float, material: int) -> Mesh:
        """Build walls over a local outline that reach into the ground. A façade's v starts at the base."""
        ring = self.world(np.array([*outline, outline[0]], float))
        mesh = walls(ring, base - FOUNDATION_M, top, material)
        # The wall's texture starts at its lower end; a façade's at the base
        mesh.uvw[..., 1] -= FOUNDATION_M
        return mesh

    def box(self, centre: Vector, size: Vector, z: tuple[float, float], material: int) -> Mesh:
        """Build a box around a local point, without texture coordinates."""
        (x, y), (a, b) = centre, (0.5 * size[0], 0.5 * size[1])
        moved = self.placed(box((x - a, y - b, z[0]), (x + a, y + b, z[1]), material))
        return Mesh(moved.xyz, np.zeros_like(moved.uvw), moved.material)
