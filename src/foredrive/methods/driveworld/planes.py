"""Networks between planes and vectors: the inputs and outputs of DriveWorld's latent dynamics."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.geometry.precision import full_precision
from foredrive.scene import VoxelSpec


class AdaptiveNorm(nn.Module):
    """Instance normalisation whose scale and shift come from a vector (AdaIN, Huang & Belongie 2017)."""

    def __init__(self, channels: int, vector: int) -> None:
        super().__init__()
        self.norm = nn.InstanceNorm2d(channels)
        self.style = nn.Linear(vector, 2 * channels)

    def forward(
        self, plane: Float[Tensor, "b C Y X"], vector: Float[Tensor, "b V"]
    ) -> Float[Tensor, "b C Y X"]:
        """Return (1 + scale) ⊙ norm(plane) + shift."""
        scale, shift = self.style(vector)[..., None, None].chunk(2, dim=1)
        # The scale is learned as a deviation from 1
        return (1 + scale) * self.norm(plane) + shift


@dataclass(frozen=True)
class PlaneToVectorConfig:
    """Sizes of a `PlaneToVector`."""

    hidden: int
    """Channels of the first convolution. The second has twice as many."""
    norm_groups: int = 4
    """Groups of the group normalisation."""
    pool_yx: tuple[int, int] = (4, 4)
    """Size of the plane that is flattened."""


class PlaneToVector(nn.Module):
    """A plane reduced to one vector x_t by strided convolutions, flattened only at the end.

    Args:
        config: sizes.
        channels: channels of the plane.
        vector: width of x_t (512 in the paper).
    """

    def __init__(self, config: PlaneToVectorConfig, *, channels: int, vector: int) -> None:
        super().__init__()
        hidden, pool_yx = config.hidden, config.pool_yx
        self.net = nn.Sequential(
            nn.Conv2d(channels, hidden, 3, stride=2, padding=1),
            nn.GroupNorm(config.norm_groups, hidden),
            nn.ReLU(),
            nn.Conv2d(hidden, 2 * hidden, 3, stride=2, padding=1),
            nn.GroupNorm(config.norm_groups, 2 * hidden),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d(pool_yx),
            nn.Flatten(),
            nn.Linear(2 * hidden * pool_yx[0] * pool_yx[1], vector),
        )

    def forward(self, plane: Float[Tensor, "b C Y X"]) -> Float[Tensor, "b V"]:
        """Return the vector."""
        return self.net(plane)


@dataclass(frozen=True)
class VectorToPlaneConfig:
    """Sizes of a `VectorToPlane`."""

    widths: tuple[int, ...]
    """Channels of each step, coarsest first. The last is that of the plane."""
    negative_slope: float = 0.2
    """Slope of the leaky ReLU below 0."""


class VectorToPlane(nn.Module):
    """A vector expanded to a plane (m_θ; the decoder of MILE).

    A learned constant is upsampled by a factor of two per step and styled by the vector at each step.

    Args:
        config: sizes.
        vector: width of the input.
        size_yx: size of the plane.
    """

    def __init__(self, config: VectorToPlaneConfig, *, vector: int, size_yx: tuple[int, int]) -> None:
        super().__init__()
        widths, self.negative_slope = config.widths, config.negative_slope
        shrunk = 2 ** (len(widths) - 1)
        # Sizes from coarse to fine, rounded up, each twice the one before; the last is that of the plane
        self.sizes = [tuple(-(-n * 2**k // shrunk) for n in size_yx) for k in range(len(widths))]
        self.constant = nn.Parameter(torch.randn(1, widths[0], *self.sizes[0]))
        before = (widths[0], *widths[:-1])
        self.convolve = nn.ModuleList(
            [nn.Conv2d(i, o, 3, padding=1) for i, o in zip(before, widths, strict=True)]
        )
        self.style = nn.ModuleList([AdaptiveNorm(width, vector) for width in widths])

    def forward(self, vector: Float[Tensor, "b V"]) -> Float[Tensor, "b C Y X"]:
        """Return the plane."""
        # The same learned constant for all items: the vector enters by the norms alone
        plane = self.constant.expand(len(vector), -1, -1, -1)
        for size, convolve, style in zip(self.sizes, self.convolve, self.style, strict=True):
            if plane.shape[-2:] != size:
                plane = F.interpolate(plane, size=size, mode="bilinear", align_corners=False)
            plane = F.leaky_relu(style(convolve(plane), vector), self.negative_slope)
        return plane


@dataclass(frozen=True)
class StaticSceneConfig:
    """Sizes of a `StaticScene`."""

    channels: int
    """Channels of the latent statics."""
    norm_groups: int = 4
    """Groups of the group normalisation."""


class StaticScene(nn.Module):
    """Static features b̂ = z_θ(b'), read from the plane of one frame and passed on without warping (§3.1)."""

    def __init__(self, config: StaticSceneConfig, *, channels: int) -> None:
        super().__init__()
        out = config.channels
        self.net = nn.Sequential(
            nn.Conv2d(channels, out, 3, padding=1),
            nn.GroupNorm(config.norm_groups, out),
            nn.ReLU(),
            nn.Conv2d(out, out, 3, padding=1),
        )

    def forward(self, plane: Float[Tensor, "b C Y X"]) -> Float[Tensor, "b _O Y X"]:
        """Return the latent statics."""
        return self.net(plane)


def warp_plane(
    plane: Float[Tensor, "b C Y X"], T_src_dst: Float[Tensor, "b 4 4"], spec: VoxelSpec
) -> Float[Tensor, "b C Y X"]:
    """Warp a plane from the frame src to the frame dst.

    Each cell of dst is read bilinearly at its place in src; it is 0 beyond the edge.

    Args:
        plane: features over the ground of `spec`, in the frame src.
        T_src_dst: transform of points dst -> src; only its motion over the ground is used.
    """
    # 32 bits, because coordinates of half precision are off by tenths of a cell
    with full_precision(plane, T_src_dst.float()) as (plane, T):
        size_xy = plane.new_tensor(spec.shape_zyx[:0:-1])
        lower = plane.new_tensor(spec.lower_m[:2])
        # Centres of the cells of dst, in metres
        y, x = (torch.arange(n).to(plane) + 0.5 for n in spec.shape_zyx[1:])
        cells_m = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1) * spec.voxel_m + lower
        # Place of each cell of dst in src: rotation over the ground, then translation
        read_m = torch.einsum("bij,yxj->byxi", T[:, :2, :2], cells_m) + T[:, None, None, :2, 3]
        # grid_sample has the borders of the image at -1 and 1
        grid = 2 * (read_m - lower) / (spec.voxel_m * size_xy) - 1
        return F.grid_sample(plane, grid, align_corners=False)


@dataclass(frozen=True)
class PlanesToVolumeConfig:
    """Sizes of a `PlanesToVolume`."""

    hidden: int
    """Channels of the volume before the last convolution."""


class PlanesToVolume(nn.Module):
    """Planes, concatenated along channels, unfolded into a feature volume: l_θ without its last layer.

    Args:
        config: sizes.
        channels: channels of all planes together.
        out: D.
        height: Z.
    """

    def __init__(self, config: PlanesToVolumeConfig, *, channels: int, out: int, height: int) -> None:
        super().__init__()
        self.height, hidden = height, config.hidden
        self.unfold = nn.Sequential(
            nn.Conv2d(channels, hidden * height, 3, padding=1),
            nn.GroupNorm(height, hidden * height),
            nn.ReLU(),
        )
        self.convolve = nn.Sequential(
            nn.Conv3d(hidden, hidden, 3, padding=1), nn.ReLU(), nn.Conv3d(hidden, out, 3, padding=1)
        )

    def forward(self, planes: Float[Tensor, "b C Y X"]) -> Float[Tensor, "b D Z Y X"]:
        """Return the volume."""
        # Each height gets its own group of channels of the 2-D convolution
        unfolded = self.unfold(planes).unflatten(1, (-1, self.height))
        return self.convolve(unfolded)
