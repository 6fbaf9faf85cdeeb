"""Volume rendering: features composited along rays, then decoded to colour (NeMo eq. 2, 5, 6)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.ops.attention3d import attend_volume
from foredrive.ops.compositing import composite, stratified_depths
from foredrive.ops.volume import sample_volume
from foredrive.scene import RenderedRays, VoxelSpec


@dataclass(frozen=True)
class RendererConfig:
    """Sizes of a `VolumeRenderer`."""

    near_m: float
    """Ray samples are stratified from this distance to `far_m`, m."""
    far_m: float
    """Distance of the end of a ray, m."""
    samples: int
    """Number of samples on a ray."""
    hidden: int
    """Width of f_recon."""


class VolumeRenderer(nn.Module):
    """A renderer of features along rays, with occupancy as alpha; f_recon maps the result to RGB.

    Eq. 5 does not define the colour of rays that leave the volume. Here the remaining transmittance falls on
    a learned background feature, which represents the sky and everything beyond the grid.

    Args:
        config: sizes.
        spec: grid of the volume.
        channels: D.
    """

    lower_m: Tensor

    def __init__(self, config: RendererConfig, spec: VoxelSpec, *, channels: int) -> None:
        super().__init__()
        self.spec, hidden = spec, config.hidden
        self.near_m, self.far_m, self.samples = config.near_m, config.far_m, config.samples
        self.register_buffer("lower_m", torch.tensor(spec.lower_m), persistent=False)
        self.background = nn.Parameter(torch.zeros(channels))
        self.recon = nn.Sequential(
            nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 3)
        )

    def forward(
        self,
        feature: Float[Tensor, "b D Z Y X"],
        occupancy_logit: Float[Tensor, "b Z Y X"],
        origin: Float[Tensor, "b R 3"],
        direction: Float[Tensor, "b R 3"],
        generator: torch.Generator | None = None,
    ) -> RenderedRays:
        """Render rays in the ego frame of the volume. Without a generator, samples are at bin centres."""
        b, rays, _ = origin.shape
        depth = stratified_depths(self.near_m, self.far_m, self.samples, (b, rays), generator)
        depth = depth.to(origin)
        # Points along each ray in the ego frame, then in cell units
        points = origin[:, :, None] + depth[..., None] * direction[:, :, None]  # [b, R, N, 3]
        place = (points - self.lower_m) / self.spec.voxel_m
        # Occupancy is the opacity of a sample (eq. 5)
        alpha = sample_volume(occupancy_logit.sigmoid()[..., None], place.flatten(1, 2))
        weights, range_m, through = composite(alpha.view(b, rays, self.samples), depth)
        # Weighted sum of the features at the samples; the weights are those of compositing
        rendered = attend_volume(feature.permute(0, 2, 3, 4, 1), place[:, :, None], weights[:, :, None])
        # The transmittance that is left at the far end shows the background
        rendered = rendered + through[..., None] * self.background
        rgb = self.recon(rendered).float().sigmoid()
        # The light that passes through counts at the far end of the ray
        return RenderedRays(rgb=rgb, range_m=range_m + through * self.far_m, alpha=1 - through)
