"""Lifting of camera features to a volume by voxel queries and deformable attention (NeMo eq. 1)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.methods.blocks.plane_context import PlaneContextConfig, plane_context
from foredrive.ops.attention3d import attend_volume
from foredrive.ops.lifting import lift
from foredrive.scene import CameraRig, Frames, VoxelSpec


def directions_2d(heads: int) -> Float[Tensor, "H 2"]:
    """Return directions on the unit square, one per head (the initialisation of Zhu et al. 2021)."""
    angle = torch.arange(heads) * (2 * math.pi / heads)
    grid = torch.stack([angle.cos(), angle.sin()], dim=-1)
    # Divided by the largest coordinate: the directions end on the border of the square
    return grid / grid.abs().amax(-1, keepdim=True)


def _directions_3d(heads: int) -> Float[Tensor, "H 3"]:
    """Return directions spread over the sphere (golden spiral), one per head, scaled to the unit cube."""
    index = torch.arange(heads) + 0.5
    # Golden spiral: heights at equal steps, azimuth turned by π(1 + √5), the golden angle up to whole turns
    z = 1 - 2 * index / heads
    angle = math.pi * (1 + math.sqrt(5)) * index
    ring = (1 - z * z).sqrt()
    grid = torch.stack([ring * angle.cos(), ring * angle.sin(), z], dim=-1)
    return grid / grid.abs().amax(-1, keepdim=True)


def position_code(centres_m: Float[Tensor, "Q 3"], channels: int) -> Float[Tensor, "Q D"]:
    """Return the initial queries: sines and cosines of the position of each voxel relative to the vehicle.

    Direction, distance and height come first, because they decide how cameras see a place; then x and y.
    These are 28 channels. Further channels start random and small; with fewer channels the last ones are cut.
    Queries that start fully random have to learn their position first.
    """
    x, y, z = centres_m.unbind(-1)
    distance, azimuth = torch.hypot(x, y), torch.atan2(y, x)
    reach, low, high = distance.max(), z.min(), z.max()
    # Azimuth at 1 to 3 periods per turn, smooth across ±π
    waves = [k * azimuth for k in range(1, 4)]
    # Distance and height at octaves from a quarter period over their range
    waves += [0.5 * math.pi * 2**k * distance / reach for k in range(5)]
    # A grid of one layer has no height range, hence the bound on the divisor
    waves += [0.5 * math.pi * 2**k * (z - low) / (high - low).clamp_min(1.0) for k in range(3)]
    code = [wave for angle in waves for wave in (angle.sin(), angle.cos())]
    code += [(math.pi * 2**k * axis / reach).sin() for k in range(3) for axis in (x, y)]
    # Small noise breaks the symmetry among the further channels
    rest = 0.02 * torch.randn(len(centres_m), max(channels - len(code), 0), device=centres_m.device)
    return torch.cat([torch.stack(code, dim=-1), rest], dim=-1)[:, :channels].contiguous()


@dataclass(frozen=True)
class LiftingConfig:
    """Sizes of a `LiftingEncoder`."""

    heads: int
    """Heads of the deformable attention to images and among voxels."""
    points: int
    """Points read per head and per level of image features."""
    layers: int
    """Rounds of refinement."""
    feed_forward: float = 2.0
    """Hidden width of the feed-forward networks, as a multiple of the channels."""
    checkpoint: bool = False
    """Keep only the input of each round for the backward pass and recompute the rest."""
    self_attention: bool = True
    """Attend among the voxels in each round. In the first round, voxels have not read images yet."""
    context: PlaneContextConfig | None = None
    """U-Net in the plane after the last round. Not part of NeMo."""
    kind: Literal["lifting"] = "lifting"


class NeighbourhoodAttention(nn.Module):
    """Deformable self-attention: each cell reads P learned places around itself, in H heads.

    Args:
        channels: D.
        directions: direction of each head's first offsets, [H, 3] in a volume and [H, 2] in a plane.
        points: P.
    """

    def __init__(self, channels: int, directions: Float[Tensor, "H _d"], points: int) -> None:
        super().__init__()
        self.heads, self.dims = directions.shape
        self.points = points
        self.value = nn.Linear(channels, channels)
        self.offset = nn.Linear(channels, self.heads * points * self.dims)
        self.weight = nn.Linear(channels, self.heads * points)
        self.out = nn.Linear(channels, channels)
        radius = torch.arange(1, points + 1).view(1, points, 1)
        # Point p of a head starts p cells away along the head's direction
        _begin_attention(self.offset, self.weight, directions[:, None] * radius)

    def forward(
        self, query: Float[Tensor, "b Q D"], shape_zyx: tuple[int, int, int], place: Float[Tensor, "Q 3"]
    ) -> Float[Tensor, "b Q D"]:
        """Attend among the cells.

        Args:
            query: cell features in Z Y X order.
            shape_zyx: shape of their grid; (1, Y, X) for a plane.
            place: cell centres in cell units (x, y, z).
        """
        b, q, _ = query.shape
        offset = self.offset(query).view(b, q, self.heads, self.points, self.dims)
        # In a plane, offsets have no height
        if self.dims == 2:
            offset = F.pad(offset, (0, 1))
        weight = self.weight(query).view(b, q, self.heads, self.points).softmax(-1)
        values = self.value(query).view(b, *shape_zyx, -1)
        return self.out(attend_volume(values, place[:, None, None] + offset, weight))


class CameraCrossAttention(nn.Module):
    """Deformable cross-attention: each cell reads P learned places around its projections, per level.

    A voxel has one projection into each camera. A cell of a plane has one for each of K heights above it. As
    in BEVFormer, one softmax then weights the points of all heights, and each height is averaged over the
    cameras that see it.

    Args:
        features: channels of the image features.
        channels: channels of the cells.
        heads: H.
        levels: L, number of image feature levels.
        points: P, per head, level and height.
        heights: K.
    """

    def __init__(
        self, features: int, channels: int, *, heads: int, levels: int, points: int, heights: int = 1
    ) -> None:
        super().__init__()
        self.shape = (heights, heads, levels, points)
        self.value = nn.Linear(features, channels)
        self.offset = nn.Linear(channels, heights * heads * levels * points * 2)
        self.weight = nn.Linear(channels, heights * heads * levels * points)
        self.out = nn.Linear(channels, channels)
        radius = torch.arange(points).view(1, points, 1)  # the first point starts on the projection
        spread = directions_2d(heads)[:, None, None] * radius
        _begin_attention(self.offset, self.weight, spread.expand(*self.shape, 2))

    def forward(
        self,
        query: Float[Tensor, "_b Q W"],
        features: Sequence[Float[Tensor, "b C _h _w D"]],
        uv: Float[Tensor, "b C N 2"],
        visible: Bool[Tensor, "b C N"],
    ) -> Float[Tensor, "b Q W"]:
        """Attend to the cameras.

        Args:
            query: cell features, of batch size b or 1.
            features: image features, one tensor per level.
            uv, visible: projections of N = Q·K points, heights last, and their visibility per camera.
        """
        b, q = len(uv), query.shape[1]
        heights, *per_height = self.shape
        offset = self.offset(query).view(-1, q * heights, *per_height, 2)
        # One softmax per cell and head over all heights, levels and points (as in BEVFormer)
        score = self.weight(query).view(-1, q, *self.shape).transpose(2, 3)  # [b Q H K L P]
        weight = score.flatten(3).softmax(-1).view(score.shape).transpose(2, 3).flatten(1, 2)
        values = [self.value(level) for level in features]
        sampled = lift(
            values, uv, visible, offset.expand(b, *offset.shape[1:]), weight.expand(b, *weight.shape[1:])
        )
        # The weights of a cell sum to 1 over its heights, so the sum over heights is a weighted mean
        return self.out(sampled if heights == 1 else sampled.unflatten(1, (q, heights)).sum(2))


def _begin_attention(offset: nn.Linear, weight: nn.Linear, first_offsets: Float[Tensor, "... _d"]) -> None:
    """Start deformable attention at fixed offsets with equal weights."""
    with torch.no_grad():
        # Zero weights below make the offsets equal to this bias and the softmax uniform at the start
        offset.bias.copy_(first_offsets.flatten())
    for parameter in (offset.weight, weight.weight, weight.bias):
        nn.init.zeros_(parameter)


class LiftingLayer(nn.Module):
    """A layer of self-attention, cross-attention and feed-forward; each is residual and normalised.

    Args:
        channels: D.
        self_attention: a `NeighbourhoodAttention` among the queries, or None.
        cross_attention: a `CameraCrossAttention` to the images.
        feed_forward: hidden width as a multiple of D.
    """

    def __init__(
        self,
        channels: int,
        self_attention: nn.Module | None,
        cross_attention: nn.Module,
        feed_forward: float,
    ) -> None:
        super().__init__()
        self.self_attention, self.cross_attention = self_attention, cross_attention
        hidden = round(feed_forward * channels)
        self.feed_forward = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, channels))
        norms = [nn.LayerNorm(channels) for _ in range(3)]
        # An Identity keeps the numbering of the norms, and with it the names of stored weights
        self.norms = nn.ModuleList(norms if self_attention is not None else [nn.Identity(), *norms[1:]])

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
        if self.self_attention is not None:
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
    """Return the queries after all `LiftingLayer`s.

    `recompute` keeps only the input of each round. A round then goes through the batch item by item, so that
    what is computed again is in memory for one item at a time.
    """
    if not (recompute and torch.is_grad_enabled()):
        for layer in layers:
            query = layer(query, shape_zyx, place, features, uv, visible)
        return query
    queries = query.split(1) if len(query) == len(uv) else (query,) * len(uv)
    seen = list(
        zip(
            zip(*(level.split(1) for level in features), strict=True),
            uv.split(1),
            visible.split(1),
            strict=True,
        )
    )
    for layer in layers:
        queries = tuple(
            checkpoint(layer, one, shape_zyx, place, *of_item, use_reentrant=False)
            for one, of_item in zip(queries, seen, strict=True)
        )
    return torch.cat(queries)


def project_to_cameras(
    points_m: Float[Tensor, "Q 3"], rig: CameraRig, image_valid: Bool[Tensor, "b C"]
) -> tuple[Float[Tensor, "b C Q 2"], Bool[Tensor, "b C Q"]]:
    """Project points of the ego frame into every image. Return positions in [0, 1] and visibility."""
    b, c = image_valid.shape
    # Every camera of every clip sees the same ego-frame points
    in_camera = transform_points(inverse_se3(rig.T_ego_cam), points_m.expand(b, c, -1, -1))
    uv, _, inside = project(in_camera, rig.K, rig.dist, rig.size_hw)
    size_wh = uv.new_tensor(rig.size_hw[::-1])
    return uv / size_wh, inside & image_valid[..., None]


def lift_frames(
    frames: Frames, backbone: nn.Module, encoder: nn.Module
) -> tuple[Float[Tensor, "b T ..."], Float[Tensor, "b C h w D"]]:
    """Return the volume or plane of each frame in its own ego frame, and the finest features of the images of
    the last one."""
    b, t, c = frames.image_valid.shape
    # Frames and clips form one batch for backbone and encoder; cameras are a separate axis for the encoder
    features = [level.unflatten(0, (b * t, c)) for level in backbone(frames.images.flatten(0, 2))]
    rig = frames.rig.map_tensors(lambda tensor: tensor.flatten(0, 1))
    lifted: Tensor = encoder(features, rig, frames.image_valid.flatten(0, 1))
    return lifted.unflatten(0, (b, t)), features[0].unflatten(0, (b, t))[:, -1]


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
        # Voxel centres in voxel units: voxel i has its centre at i + 0.5
        place = (centres - torch.tensor(spec.lower_m)) / spec.voxel_m
        self.register_buffer("place", place, persistent=False)
        self.query = nn.Parameter(position_code(centres, channels))
        self.layers = nn.ModuleList(
            [
                LiftingLayer(
                    channels,
                    NeighbourhoodAttention(channels, _directions_3d(config.heads), config.points)
                    if config.self_attention
                    else None,
                    CameraCrossAttention(
                        channels, channels, heads=config.heads, levels=levels, points=config.points
                    ),
                    config.feed_forward,
                )
                for _ in range(config.layers)
            ]
        )
        self.context = plane_context(config.context, spec, channels)

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
        volume: Tensor = self.context(query.unflatten(1, self.spec.shape_zyx).permute(0, 4, 1, 2, 3))
        return volume
