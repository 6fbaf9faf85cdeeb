"""Eyes of a driver that read the volume and the image features of NeMo."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.driver.eyes import blacked, seen_frames
from foredrive.driver.route_cells import line_cells, route_cells
from foredrive.driver.sight import RouteReader, Sight
from foredrive.geometry.precision import full_precision
from foredrive.geometry.se3 import compose_se3, inverse_se3, transform_points
from foredrive.methods.blocks.lifting import lift_frames
from foredrive.methods.nemo import Nemo, NemoConfig
from foredrive.scene import Clip, VoxelSpec, last_frames

HEIGHTS_M = (0.0, 1.0, 2.0)
"""Heights above the road at which the volume is read."""


@dataclass(frozen=True)
class VolumeEyesConfig:
    """Sizes of `VolumeEyes`."""

    world: NemoConfig
    voxels: VoxelSpec
    """Grid of the volume."""
    frames: int = 2
    """Key frames that are read, now included."""
    cameras: int = 2
    """Number of cameras that are read."""
    frozen: bool = False
    """The backbone and the encoder stay as they were pre-trained; what reads them is trained."""
    signs: bool = False
    """Stop signs are read too."""
    blind: bool = False
    """Images are black, to measure what follows from the route alone."""
    kind: Literal["volume"] = "volume"


class VolumeEyes(nn.Module):
    """NeMo's backbone and encoder; the volumes of some key frames are read along the route.

    As in `CameraEyes`, cells are fixed in the world: those before now are read in the volume of their frame.
    Lamps are above the volume, so they are read in the finest image features.

    Args:
        config: sizes.
    """

    def __init__(self, config: VolumeEyesConfig) -> None:
        super().__init__()
        self.config = config
        world = Nemo(
            config.world, config.voxels, past_frames=config.frames - 1, max_steps=1, dt_s=0.5, fetch=False
        )
        self.backbone, self.encoder, channels = world.backbone, world.encoder, world.channels
        # Per frame and height: the volume's channels, and whether the cell is in the volume
        of_cell = config.frames * len(HEIGHTS_M) * (channels + 1)
        self.reader = RouteReader(
            of_cell, channels + 1, channels, channels, config.cameras, signs=config.signs
        )
        if config.frozen:
            self.backbone.requires_grad_(False)
            self.encoder.requires_grad_(False)

    def train(self, mode: bool = True) -> "VolumeEyes":
        """Set the mode. What is frozen stays in evaluation mode."""
        super().train(mode)
        if self.config.frozen:
            self.backbone.eval()
            self.encoder.eval()
        return self

    def forward(self, clip: Clip) -> Sight:
        """Return what is seen of the route at now.

        Raises:
            InputError: the clip has other cameras or fewer frames.
        """
        config = self.config
        clip = blacked(clip) if config.blind else clip
        frames = seen_frames(clip, config.frames, config.cameras)
        seen = last_frames(clip.observed(), config.frames - 1)
        with torch.set_grad_enabled(torch.is_grad_enabled() and not config.frozen):
            volumes, images = lift_frames(seen, self.backbone, self.encoder)
        fine = images.permute(0, 1, 4, 2, 3)
        cells = self._read(frames, route_cells(clip.route_xy, clip.route_valid), volumes)
        now, line = frames.frames([frames.now]), line_cells(clip.route_xy, clip.route_valid)
        ground = self._read(now, line, volumes[:, -1:], (0.0,))
        sight: Sight = self.reader(clip, cells, ground, fine, fine.mean((-2, -1)))
        return sight

    def _read(
        self,
        frames: Clip,
        cells: Float[Tensor, "b G L 2"],
        volumes: Float[Tensor, "b T D Z Y X"],
        heights_m: Sequence[float] = HEIGHTS_M,
    ) -> Float[Tensor, "b _N G L"]:
        """Return the features of all frames in the cells, and whether a cell is in the volume."""
        count, spec = len(heights_m), self.config.voxels
        # Cells at each height, in the ego frame of every key frame
        z = cells.new_tensor(heights_m)[:, None, None, None].expand(count, *cells.shape[1:3], 1)
        points = torch.cat(
            [cells[:, None].expand(-1, count, -1, -1, -1), z.expand(len(cells), *z.shape)], dim=-1
        ).flatten(1, 3)
        T_frame_now = compose_se3(inverse_se3(frames.T_world_ego), frames.T_world_ego[:, -1:]).float()
        lower = points.new_tensor(spec.lower_m)
        size_m = spec.voxel_m * points.new_tensor(spec.shape_zyx[::-1])
        read = []
        for t in range(volumes.shape[1]):
            with full_precision(volumes[:, t], transform_points(T_frame_now[:, t], points)) as (volume, at_m):
                # Metres to grid_sample's range in the volume
                place = 2 * (at_m - lower) / size_m - 1
                inside = (place.abs() < 1).all(-1)
                where = place.clamp(-2, 2)[:, :, None, None]
                values = F.grid_sample(volume, where, align_corners=False)[..., 0, 0]
            both = torch.cat([values, inside[:, None].to(values)], dim=1)
            both = both.unflatten(-1, (count, *cells.shape[1:3])).permute(0, 2, 1, 3, 4)
            read.append(both.flatten(1, 2))
        return torch.cat(read, dim=1)
