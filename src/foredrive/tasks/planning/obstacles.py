"""Annotated boxes of the future, in the ego frame of the moment of planning."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3, rotate_vectors, transform_points
from foredrive.scene import Boxes, Clip
from foredrive.scene.record import Record

FRAME_TOLERANCE_S = 0.15
"""Key frames are not spaced exactly: a frame this close to a step's time stands for it."""
OBSERVED_S = 1.0


@dataclass(frozen=True)
class Obstacles(Record):
    """Boxes at each of T future steps, in the ego frame at now."""

    boxes: Boxes
    """Leading dimensions [b T]."""
    annotated: Bool[Tensor, "b T"]
    """Whether the step has annotations at all."""
    tracked_now: Bool[Tensor, "b T M"]
    """Whether the box's track is annotated at now."""
    tracked_lately: Bool[Tensor, "b T M"]
    """Whether it is annotated at now or within the second before."""
    annotated_now: Bool[Tensor, "b"]


def boxes_at_now(clip: Clip) -> Boxes:
    """Return the boxes of every frame of a clip [b T M] in the ego frame at now, velocities too."""
    now = clip.now
    # Motion from each frame to now; headings and velocities turn with it, positions move as well
    T_now_ego = inverse_se3(clip.T_world_ego[:, now : now + 1]) @ clip.T_world_ego  # [b, T, 4, 4]
    boxes = clip.boxes
    heading = torch.stack([boxes.yaw.cos(), boxes.yaw.sin(), torch.zeros_like(boxes.yaw)], dim=-1)
    velocity = torch.cat([boxes.velocity, torch.zeros_like(boxes.velocity[..., :1])], dim=-1)
    heading = rotate_vectors(T_now_ego, heading.double())
    return dataclasses.replace(
        boxes,
        centre=transform_points(T_now_ego, boxes.centre.double()).to(boxes.centre),
        yaw=torch.atan2(heading[..., 1], heading[..., 0]).to(boxes.yaw),
        velocity=rotate_vectors(T_now_ego, velocity.double())[..., :2].to(boxes.velocity),
    )


def future_obstacles(clip: Clip, steps: int, step_s: float) -> Obstacles:
    """Return the obstacles at `steps` times, `step_s` apart, after now.

    A step takes the boxes of the key frame nearest in time. Where none lies within 0.15 s, or the frame is
    not annotated, `annotated` is False and the step has no boxes.
    """
    if clip.t_s.dim() != 2:
        raise InputError(f"expected a batch of clips, got t_s of shape {tuple(clip.t_s.shape)}")
    now = clip.now
    wanted_s = step_s * torch.arange(1, steps + 1, device=clip.t_s.device, dtype=clip.t_s.dtype)
    # Key frame nearest to each step
    distance_s, frame = (clip.t_s[:, None, :] - wanted_s[:, None]).abs().min(dim=-1)  # [b, steps]
    item = torch.arange(len(frame), device=frame.device)[:, None]
    # A step counts as annotated only if a key frame is near and has boxes
    annotated = (distance_s <= FRAME_TOLERANCE_S) & clip.boxes_valid[item, frame]
    boxes = boxes_at_now(clip)[item, frame]

    # Key frames of the last second up to now
    lately = (clip.t_s >= -OBSERVED_S - FRAME_TOLERANCE_S) & clip.boxes_valid
    lately[:, now + 1 :] = False
    past_valid = clip.boxes.valid & lately[..., None]  # [b, T, M]
    boxes = dataclasses.replace(boxes, valid=boxes.valid & annotated[..., None])
    return Obstacles(
        boxes=boxes,
        annotated=annotated,
        tracked_now=_tracked(boxes, clip.boxes.track_id[:, now : now + 1], past_valid[:, now : now + 1]),
        tracked_lately=_tracked(boxes, clip.boxes.track_id[:, : now + 1], past_valid[:, : now + 1]),
        annotated_now=clip.boxes_valid[:, now],
    )


def _tracked(boxes: Boxes, track_id: Tensor, valid: Tensor) -> Bool[Tensor, "b T M"]:
    """Return whether each box's track is among the valid ones of `track_id` [b, frames, M]."""
    # Compare the track of each box with all tracks of these frames
    same = boxes.track_id[..., None] == track_id.flatten(1)[:, None, None, :]  # [b, T, M, frames * M]
    return (same & valid.flatten(1)[:, None, None, :]).any(dim=-1) & boxes.valid
