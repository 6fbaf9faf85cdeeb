"""Lifting of camera features to a volume by voxel queries and deformable attention (NeMo eq. 1)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.ops.attention3d import attend_volume
from foredrive.ops.lifting import lift
from foredrive.scene import CameraRig, VoxelSpec


def directions_2d(heads: int) -> Float[Tensor, "H 2"]:
    """Return directions on the unit square, one per head (the initialisation of Zhu et al. 2021)."""
    angle = torch.arange(heads) * (2 * math.pi / heads)
    grid = torch.stack([angle.cos(), angle.sin()], dim=-1)
    return grid / grid.abs().amax(-1, keepdim=True)


def _directions_3d(heads: int) -> Float[Tensor, "H 3"]:
    """Return directions spread over the sphere (golden spiral), one per head, scaled to the unit cube."""
    index = torch.arange(heads) + 0.5
    z = 1 - 2 * index / heads
    angle = math.pi * (1 + math.sqrt(5)) * index
    ring = (1 - z * z).sqrt()
    grid = torch.stack([ring * angle.cos(), ring * angle.sin(), z], dim=-1)
    return grid / grid.abs().amax(-1, keepdim=True)


def place_code(centres_m: Float[Tensor, "Q 3"], channels: int) -> Float[Tensor, "Q D"]:
    """Return the initial queries: sines and cosines of the position of each voxel relative to the vehicle.

    Direction, distance and height come first, because they decide how cameras see a place; then x and y.
    These are 28 channels. Further channels start random and small; with fewer channels the last ones are cut.
    Queries that start fully random have to learn their position first.
    """
    x, y, z = centres_m.unbind(-1)
    distance, azimuth = torch.hypot(x, y), torch.atan2(y, x)
    reach, low, high = distance.max(), z.min(), z.max()
    waves = [k * azimuth for k in range(1, 4)]
    waves += [0.5 * math.pi * 2**k * distance / reach for k in range(5)]
    waves += [0.5 * math.pi * 2**k * (z - low) / (high - low).clamp_min(1.0) for k in range(3)]
    code = [wave for angle in waves for wave in (angle.sin(), angle.cos())]
    code += [(math.pi * 2**k * axis / reach).sin() for k in range(3) for axis in (x, y)]
    rest = 0.02 * torch.randn(len(centres_m), max(channels - len(code), 0), device=centres_m.device)
    return torch.cat([torch.stack(code, dim=-1), rest], dim=-1)[:, :channels].contiguous()


@dataclass(frozen=True)
class LiftingConfig:
    """Sizes of a `LiftingEncoder`."""

    heads: int
    points: int
    """Points read per head and per level of image features."""
    layers: int
    """Rounds of refinement."""
    feed_forward: float = 2.0
    """Hidden width of the feed-forward networks, as a multiple of the channels."""
    checkpoint: bool = False
    """Keep only the input of each round for the backward pass and recompute the rest."""
    kind: Literal["lifting"] = "lifting"


class VolumeSelfAttention(nn.Module):
    """Deformable self-attention in 3-D: each voxel reads P learned places around itself, in H heads."""

    def __init__(self, channels: int, heads: int, points: int) -> None:
        super().__init__()
        self.heads, self.points = heads, points
        self.value = nn.Linear(channels, channels)
        self.offset = nn.Linear(channels, heads * points * 3)
        self.weight = nn.Linear(channels, heads * points)
        self.out = nn.Linear(channels, channels)
        nn.init.zeros_(self.offset.weight)
        radius = torch.arange(1, points + 1).view(1, points, 1)
        with torch.no_grad():
            self.offset.bias.copy_((_directions_3d(heads)[:, None] * radius).flatten())
        nn.init.zeros_(self.weight.weight)
        nn.init.zeros_(self.weight.bias)

    def forward(
        self, query: Float[Tensor, "b Q D"], shape_zyx: tuple[int, int, int], place: Float[Tensor, "Q 3"]
    ) -> Float[Tensor, "b Q D"]:
        """Attend among the voxels.

        Args:
            query: voxel features in Z Y X order.
            shape_zyx: shape of their grid.
            place: voxel centres in voxel units (x, y, z).
        """
        b, q, _ = query.shape
        offset = self.offset(query).view(b, q, self.heads, self.points, 3)
        weight = self.weight(query).view(b, q, self.heads, self.points).softmax(-1)
        values = self.value(query).view(b, *shape_zyx, -1)
        return self.out(attend_volume(values, place[:, None, None] + offset, weight))


class CameraCrossAttention(nn.Module):
    """Deformable cross-attention: each voxel reads P learned places around its projection, per level."""

    def __init__(self, channels: int, heads: int, levels: int, points: int) -> None:
        super().__init__()
        self.heads, self.levels, self.points = heads, levels, points
        self.value = nn.Linear(channels, channels)
        self.offset = nn.Linear(channels, heads * levels * points * 2)
        self.weight = nn.Linear(channels, heads * levels * points)
        self.out = nn.Linear(channels, channels)
        nn.init.zeros_(self.offset.weight)
        radius = torch.arange(points).view(1, 1, points, 1)  # the first point starts on the projection
        with torch.no_grad():
            spread = directions_2d(heads)[:, None, None] * radius
            self.offset.bias.copy_(spread.expand(heads, levels, points, 2).flatten())
        nn.init.zeros_(self.weight.weight)
        nn.init.zeros_(self.weight.bias)

    def forward(
        self,
        query: Float[Tensor, "_b Q D"],
        features: Sequence[Float[Tensor, "b C _h _w D"]],
        uv: Float[Tensor, "b C Q 2"],
        visible: Bool[Tensor, "b C Q"],
    ) -> Float[Tensor, "b Q D"]:
        """Attend to the cameras.

        Args:
            query: voxel features, of batch size b or 1.
            features: image features, one tensor per level.
            uv, visible: projections of the voxels and their visibility per camera.
        """
        q, b = query.shape[1], len(uv)
        offset = self.offset(query).view(-1, q, self.heads, self.levels, self.points, 2)
        weight = self.weight(query).view(-1, q, self.heads, self.levels * self.points).softmax(-1)
        weight = weight.view(-1, q, self.heads, self.levels, self.points)
        values = [self.value(level) for level in features]
        read = lift(
            values, uv, visible, offset.expand(b, *offset.shape[1:]), weight.expand(b, *weight.shape[1:])
        )
        return self.out(read)


class LiftingLayer(nn.Module):
    """A layer of self-attention, cross-attention and feed-forward; each is residual and normalised.

    Args:
        channels: D.
        self_attention: among the queries, as `VolumeSelfAttention`.
        cross_attention: to the cameras, as `CameraCrossAttention`.
        feed_forward: hidden width as a multiple of D.
    """

    def __init__(
        self, channels: int, self_attention: nn.Module, cross_attention: nn.Module, feed_forward: float
    ) -> None:
        super().__init__()
        self.self_attention, self.cross_attention = self_attention, cross_attention
        hidden = round(feed_forward * channels)
        self.feed_forward = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, channels))
        self.norms = nn.ModuleList([nn.LayerNorm(channels) for _ in range(3)])

    def forward(
        self,
        query: Float[Tensor, "_b Q D"],
        shape_zyx: tuple[int, int, int],
        place: Float[Tensor, "Q 3"],
        features: Sequence[Float[Tensor, "b C _h _w _d"]],
        uv: Float[Tensor, "b C N 2"],
        visible: Bool[Tensor, "b C N"],
    ) -> Float[Tensor, "b Q D"]:
        """Run one round of refinement. The arguments are those of the two attentions.

        A query batch of 1 means that the queries are still the same for the whole batch. Until they have read
        images, the work on them is done once.
        """
        query = self.norms[0](query + self.self_attention(query, shape_zyx, place))
        query = self.norms[1](query + self.cross_attention(query, features, uv, visible))
        return self.norms[2](query + self.feed_forward(query))


def refine(
    layers: nn.ModuleList,
    query: Float[Tensor, "_b Q D"],
    shape_zyx: tuple[int, int, int],
    place: Float[Tensor, "Q 3"],
    features: Sequence[Float[Tensor, "b C _h _w _d"]],
    uv: Float[Tensor, "b C N 2"],
    visible: Bool[Tensor, "b C N"],
    *,
    recompute: bool,
) -> Float[Tensor, "_b Q D"]:
    """Return the queries after all `LiftingLayer`s. `recompute` keeps only the input of each round."""
    for layer in layers:
        inputs = (query, shape_zyx, place, features, uv, visible)
        if recompute and torch.is_grad_enabled():
            query = checkpoint(layer, *inputs, use_reentrant=False)
        else:
            query = layer(*inputs)
    return query


def project_to_cameras(
    points_m: Float[Tensor, "Q 3"], rig: CameraRig, image_valid: Bool[Tensor, "b C"]
) -> tuple[Float[Tensor, "b C Q 2"], Bool[Tensor, "b C Q"]]:
    """Project points of the ego frame into every image. Return positions in [0, 1] and visibility."""
    b, c = image_valid.shape
    in_camera = transform_points(inverse_se3(rig.T_ego_cam), points_m.expand(b, c, -1, -1))
    uv, _, inside = project(in_camera, rig.K, rig.dist, rig.size_hw)
    size_wh = uv.new_tensor(rig.size_hw[::-1])
    return uv / size_wh, inside & image_valid[..., None]


class LiftingEncoder(nn.Module):
    """An encoder from learned queries F ∈ R^{X×Y×Z×D} to a volume V (NeMo eq. 1).

    Args:
        config: sizes.
        spec: grid of the volume.
        channels: D.
        levels: number of image feature levels.
    """

    place: Tensor
    centres_m: Tensor

    def __init__(self, config: LiftingConfig, spec: VoxelSpec, *, channels: int, levels: int) -> None:
        super().__init__()
        self.spec, self.checkpoint = spec, config.checkpoint
        centres = spec.centres_m(torch.get_default_device()).flatten(0, 2)
        self.register_buffer("centres_m", centres, persistent=False)
        place = (centres - torch.tensor(spec.lower_m)) / spec.voxel_m
        self.register_buffer("place", place, persistent=False)
        self.query = nn.Parameter(place_code(centres, channels))
        self.layers = nn.ModuleList(
            [
                LiftingLayer(
                    channels,
                    VolumeSelfAttention(channels, config.heads, config.points),
                    CameraCrossAttention(channels, config.heads, levels, config.points),
                    config.feed_forward,
                )
                for _ in range(config.layers)
            ]
        )

    def forward(
        self,
        features: Sequence[Float[Tensor, "b C _h _w D"]],
        rig: CameraRig,
        image_valid: Bool[Tensor, "b C"],
    ) -> Float[Tensor, "b D Z Y X"]:
        """Lift image features. The result is channels-last in memory."""
        uv, visible = project_to_cameras(self.centres_m, rig, image_valid)
        query = refine(
            self.layers,
            self.query[None],  # the first layer expands it to the batch
            self.spec.shape_zyx,
            self.place,
            features,
            uv,
            visible,
            recompute=self.checkpoint,
        )
        return query.unflatten(1, self.spec.shape_zyx).permute(0, 4, 1, 2, 3)
