"""Augmentation of training examples: mirroring, colour changes and cameras that are left out."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from foredrive.data.truth.mirrored import mirrored_truth
from foredrive.errors import InputError
from foredrive.scene import Boxes, CameraRig, Clip, Command, Example, LidarSweep, VoxelGrid


@dataclass(frozen=True)
class AugmentConfig:
    """Augmentation of a training stage, drawn for each item of each batch. The default is no augmentation."""

    mirror: float = 0.0
    """Probability that left and right are exchanged."""
    colour: float = 0.0
    """Maximum relative change of the brightness, and half of it of each colour channel."""
    camera_dropout: float = 0.0
    """Probability that a camera is left out, in all frames of the clip."""


def augmented(
    example: Example, config: AugmentConfig, generator: torch.Generator, frames: int = 1
) -> Example:
    """Return a batch after augmentation. Its random numbers come from `generator` alone.

    Args:
        frames: items of a sequence, of which all or none are mirrored.
    """
    batch, cameras = example.clip.image_valid.shape[0], example.clip.image_valid.shape[2]
    if config.mirror > 0:
        drawn = torch.rand(batch // frames, generator=generator) < config.mirror
        example = mirrored(example, drawn.repeat_interleave(frames))
    clip = example.clip
    if config.colour > 0:
        drawn = config.colour * (2 * torch.rand(batch, 4, generator=generator) - 1)
        # One factor for the brightness, and smaller ones for the three channels
        gain = (1 + drawn[:, :1]) * (1 + 0.5 * drawn[:, 1:])
        clip = dataclasses.replace(clip, images=_scaled(clip.images, gain.to(clip.images.device)))
    if config.camera_dropout > 0:
        kept = torch.rand(batch, 1, cameras, generator=generator) >= config.camera_dropout
        kept = kept.to(clip.images.device)
        clip = dataclasses.replace(
            clip, images=clip.images * kept[..., None, None, None], image_valid=clip.image_valid & kept
        )
    return dataclasses.replace(example, clip=clip)


def _scaled(images: UInt8[Tensor, "b T C 3 H W"], gain: Float[Tensor, "b 3"]) -> UInt8[Tensor, "b T C 3 H W"]:
    return (images * gain[:, None, None, :, None, None]).round_().clamp_(0, 255).to(torch.uint8)


def mirrored(example: Example, chosen: Bool[Tensor, "b"]) -> Example:
    """Return a batch in which the chosen items are mirrored in the x-z plane of the ego vehicle.

    The world is mirrored with it, so traffic keeps to the other side of the road. Each camera keeps its name
    and its place in the order.

    Raises:
        InputError: the voxel grid is not symmetric about y = 0.
    """
    spec = example.occupancy.spec
    if abs(spec.lower_m[1] + spec.upper_m[1]) > 1e-6 * spec.voxel_m:
        raise InputError(f"a grid is mirrored only if it is symmetric about y = 0: {spec}")
    chosen = chosen.to(example.clip.t_s.device)
    occupancy, flow = example.occupancy, example.flow
    return dataclasses.replace(
        example,
        clip=_mirrored_clip(example.clip, chosen),
        occupancy=_mirrored_grid(occupancy, occupancy.values, chosen),
        flow=_mirrored_grid(flow, _negated(flow.values, chosen, (1.0, -1.0, 1.0), dim=2), chosen),
        truth=None if example.truth is None else mirrored_truth(example.truth, chosen),
    )


def _mirrored_clip(clip: Clip, chosen: Bool[Tensor, "b"]) -> Clip:
    # The sum of both turns minus one of them is the other
    turned = clip.command.where(clip.command == Command.STRAIGHT, Command.LEFT + Command.RIGHT - clip.command)
    return dataclasses.replace(
        clip,
        T_world_ego=mirrored_pose(clip.T_world_ego, chosen, axis=1),
        images=_flipped(clip.images, chosen, dim=-1),
        rig=_mirrored_rig(clip.rig, chosen),
        sweeps=_mirrored_sweep(clip.sweeps, chosen),
        boxes=mirrored_boxes(clip.boxes, chosen),
        command=_pick(chosen, turned, clip.command),
        route_xy=_negated(clip.route_xy, chosen, (1.0, -1.0)),
        future=dataclasses.replace(
            clip.future,
            xy=_negated(clip.future.xy, chosen, (1.0, -1.0)),
            yaw=_pick(chosen, -clip.future.yaw, clip.future.yaw),
        ),
        map=None
        if clip.map is None
        else dataclasses.replace(clip.map, vertices=_negated(clip.map.vertices, chosen, (1.0, -1.0, 1.0))),
    )


def _mirrored_rig(rig: CameraRig, chosen: Bool[Tensor, "b"]) -> CameraRig:
    """Mirror the images (u becomes W - u) and the cameras with their own x axis."""
    K = rig.K.clone()
    # With u' = W - u and x' = -x, the focal length keeps its sign and the skew changes it
    K[..., 0, 1] *= -1
    K[..., 0, 2] = rig.size_hw[1] - K[..., 0, 2]
    return dataclasses.replace(
        rig,
        K=_pick(chosen, K, rig.K),
        T_ego_cam=mirrored_pose(rig.T_ego_cam, chosen, axis=0),
        dist=_negated(rig.dist, chosen, (1.0, 1.0, 1.0, -1.0, 1.0)),  # k1 k2 p1 p2 k3: p2 is odd in x
    )


def _mirrored_sweep(sweep: LidarSweep, chosen: Bool[Tensor, "b"]) -> LidarSweep:
    return dataclasses.replace(
        sweep,
        origin_ego=_negated(sweep.origin_ego, chosen, (1.0, -1.0, 1.0)),
        dir_ego=_negated(sweep.dir_ego, chosen, (1.0, -1.0, 1.0)),
    )


def mirrored_boxes(boxes: Boxes, chosen: Bool[Tensor, "b"]) -> Boxes:
    """Mirror the chosen items of a batch in the x-z plane."""
    return dataclasses.replace(
        boxes,
        centre=_negated(boxes.centre, chosen, (1.0, -1.0, 1.0)),
        yaw=_pick(chosen, -boxes.yaw, boxes.yaw),
        velocity=_negated(boxes.velocity, chosen, (1.0, -1.0)),
    )


def _mirrored_grid(
    grid: VoxelGrid, values: Float[Tensor, "b T D Z Y X"], chosen: Bool[Tensor, "b"]
) -> VoxelGrid:
    return dataclasses.replace(
        grid,
        values=_flipped(values, chosen, dim=-2),
        known=_flipped(grid.known, chosen, dim=-2),
    )


def mirrored_pose(pose: Float[Tensor, "b *n 4 4"], chosen: Bool[Tensor, "b"], axis: int) -> Tensor:
    """Mirror poses from a frame with mirrored axis `axis` to a frame with mirrored y axis."""
    # M_to T M_source with diagonal mirrors M: signs of rows and of columns
    to, source = pose.new_ones(4), pose.new_ones(4)
    to[1], source[axis] = -1, -1
    return _pick(chosen, pose * to[:, None] * source, pose)


def _negated(values: Tensor, chosen: Bool[Tensor, "b"], signs: tuple[float, ...], dim: int = -1) -> Tensor:
    """Multiply the entries along `dim` by signs, in the chosen items."""
    shape = [1] * values.dim()
    shape[dim] = len(signs)
    return _pick(chosen, values * values.new_tensor(signs).view(shape), values)


def _flipped(values: Tensor, chosen: Bool[Tensor, "b"], dim: int) -> Tensor:
    """Reverse a dimension of the chosen items. Only these are touched: flips of images are slow."""
    out = values.clone()
    out[chosen] = values[chosen].flip(dim)
    return out


def _pick(chosen: Bool[Tensor, "b"], one: Tensor, other: Tensor) -> Tensor:
    return torch.where(chosen.view(-1, *[1] * (one.dim() - 1)), one, other)
