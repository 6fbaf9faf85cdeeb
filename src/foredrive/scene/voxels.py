"""Regular 3-D grids in the ego frame."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.scene.record import Record

MOVING_MPS = 0.5
"""Speed from which the content of a voxel counts as moving, m/s."""


@dataclass(frozen=True)
class VoxelSpec:
    """Position and resolution of a grid in the ego frame. The index order is Z, Y, X."""

    lower_m: tuple[float, float, float]
    """x, y, z of the grid's lower corner, m."""
    voxel_m: float
    """Edge length of the cubic voxels, m."""
    shape_zyx: tuple[int, int, int]
    """Number of voxels along z, y and x."""

    @property
    def upper_m(self) -> tuple[float, float, float]:
        """Return x, y, z of the grid's upper corner, m."""
        nz, ny, nx = self.shape_zyx
        x, y, z = self.lower_m
        return (x + nx * self.voxel_m, y + ny * self.voxel_m, z + nz * self.voxel_m)

    def covers(self, points_m: Float[Tensor, "*n _D"]) -> Bool[Tensor, "*n"]:
        """Return whether points of the ego frame are inside of the grid as seen from above.

        Args:
            points_m: x, y and any further coordinates.
        """
        xy = points_m[..., :2]
        lower, upper = (xy.new_tensor(corner[:2]) for corner in (self.lower_m, self.upper_m))
        return ((xy >= lower) & (xy < upper)).all(dim=-1)

    def centres_m(self, device: torch.device | str = "cpu") -> Float[Tensor, "Z Y X 3"]:
        """Return the voxel centres in the ego frame, m. The last dimension is x y z."""
        axes = [
            low + (torch.arange(n, device=device, dtype=torch.float32) + 0.5) * self.voxel_m
            for low, n in zip(self.lower_m, self.shape_zyx[::-1], strict=True)
        ]
        z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
        return torch.stack([x, y, z], dim=-1)


@dataclass(frozen=True)
class VoxelGrid(Record):
    """Values on a grid. `known` is False for voxels that no beam has observed; these are not free voxels."""

    spec: VoxelSpec
    values: Float[Tensor, "*b D Z Y X"]
    known: Bool[Tensor, "*b Z Y X"]
