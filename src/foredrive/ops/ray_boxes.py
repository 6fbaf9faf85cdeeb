"""Intersections of rays with the boxes of moving actors, each ray at its own time.

Rows that get gradients are gathered by `index_select`: the gradient of a[index] is added up in the order of
threads, which changes the last bits from run to run.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.geometry.precision import full_precision
from foredrive.geometry.se3 import exp_se3, log_so3
from foredrive.ops.precision import numba_supports, triton_supports
from foredrive.ops.ray_box_kernels import RayBoxInputs, cross_rays
from foredrive.ops.threads import in_parallel

MIN_RAYS = 256
"""Minimum number of rays per thread."""


class MovingBoxes(NamedTuple):
    """A boxes with poses at K common key times."""

    key_t_s: Float[Tensor, "K"]
    """Ascending, s."""
    T_scene_box: Float[Tensor, "A K 4 4"]
    """Poses of the boxes' centres."""
    half_size_m: Float[Tensor, "A 3"]
    present: Bool[Tensor, "A K"]
    """True where a pose is defined."""
    hold_s: float = math.inf
    """Time around a single key time for which boxes are there, s."""


class Crossings(NamedTuple):
    """P pairs of a ray and a box that it passes through, by ray and then by distance of entry."""

    ray: Int[Tensor, "P"]
    box: Int[Tensor, "P"]
    enter_m: Float[Tensor, "P"]
    """Distance along the ray, 0 if the ray starts in the box."""
    leave_m: Float[Tensor, "P"]
    origin_box: Float[Tensor, "P 3"]
    """The ray's origin in the frame of the box at the ray's time, m."""
    direction_box: Float[Tensor, "P 3"]
    """The ray's direction in that frame."""


def cross_boxes(
    origin: Float[Tensor, "R 3"],
    direction: Float[Tensor, "R 3"],
    t_s: Float[Tensor, "R"],
    boxes: MovingBoxes,
) -> Crossings:
    """Find the boxes that each ray passes through.

    Between key times the centres move linearly and rotations are about one axis, as in
    `methods.reconstruction.tracks.poses_at`. A box is there between two key times at which it is present.
    Before the first and after the last key time its motion continues for at most one step between key times.
    With a single key time it stands still.

    The distances and the rays in the boxes' frames are differentiable in the rays and in the poses. Which
    pairs there are is not.

    Args:
        origin, direction: rays in the scene's frame; directions are unit vectors.
        t_s: time of each ray.
        boxes: boxes with half their sizes.
    """
    with full_precision(origin, direction, t_s, boxes.T_scene_box) as (origin, direction, t_s, T):
        boxes = boxes._replace(
            T_scene_box=T, key_t_s=boxes.key_t_s.to(T), half_size_m=boxes.half_size_m.to(T)
        )
        # Which pairs there are has no gradient. Distances are computed again for the pairs found
        segment, share = _segments(boxes.key_t_s, t_s.detach())
        # A segment shows a box if both of its key times do
        shown = boxes.present[:, :1] if boxes.present.shape[1] == 1 else _both(boxes.present)
        plain = (origin.detach(), direction.detach(), segment, share, boxes)
        if len(T) == 0 or len(origin) == 0:
            pair = segment.new_zeros(0, 2)
        elif triton_supports(origin, direction, T):
            from foredrive.ops.ray_boxes_triton import crossing_pairs_triton  # Triton may be missing

            pair = crossing_pairs_triton(key_poses(*plain, shown))
        elif numba_supports(origin, direction, T):
            pair = _crossing_pairs(key_poses(*plain, shown))
        else:
            pair = crossing_pairs_reference(*plain, shown)
        # Beyond the key times, motion continues for a limited time only
        pair = pair[_near(boxes, t_s.detach(), share)[pair[:, 0]]]
        return _crossings(pair, origin, direction, t_s, segment, boxes)


class KeyPoses(NamedTuple):
    """Inputs of the kernels: rays with their segments of time, and the boxes' motion in each segment."""

    origin: Float[Tensor, "R 3"]
    direction: Float[Tensor, "R 3"]
    segment: Int[Tensor, "R"]
    share: Float[Tensor, "R"]
    position: Float[Tensor, "A K 3"]
    rotation: Float[Tensor, "A K 3 3"]
    turn: Float[Tensor, "A K 3"]
    half_size: Float[Tensor, "A 3"]
    shown: Bool[Tensor, "A S"]


def key_poses(
    origin: Float[Tensor, "R 3"],
    direction: Float[Tensor, "R 3"],
    segment: Int[Tensor, "R"],
    share: Float[Tensor, "R"],
    boxes: MovingBoxes,
    shown: Bool[Tensor, "A S"],
) -> KeyPoses:
    """Return the boxes' motion in the form that the kernels read."""
    T = boxes.T_scene_box.detach()
    rotation = T[..., :3, :3]
    # Rotation vector in the box' axes between successive key times
    turn = torch.zeros_like(T[..., :3, 3])
    turn[:, :-1] = log_so3(rotation[:, :-1].transpose(-1, -2) @ rotation[:, 1:])
    given = (origin, direction, segment.to(torch.int32), share, T[..., :3, 3], rotation, turn)
    return KeyPoses(*(tensor.contiguous() for tensor in (*given, boxes.half_size_m, shown)))


def _segments(
    key_t_s: Float[Tensor, "K"], t_s: Float[Tensor, "R"]
) -> tuple[Int[Tensor, "R"], Float[Tensor, "R"]]:
    """Return the key time before each time, and the part of the way to the next one."""
    if len(key_t_s) == 1:
        return torch.zeros_like(t_s, dtype=torch.int64), torch.zeros_like(t_s)
    # Times before the first and after the last key time use the outer segment: share < 0 or > 1
    after = torch.searchsorted(key_t_s.contiguous(), t_s.contiguous()).clamp(1, len(key_t_s) - 1)
    before_s = key_t_s[after - 1]
    return after - 1, (t_s - before_s) / (key_t_s[after] - before_s)


def _near(boxes: MovingBoxes, t_s: Float[Tensor, "R"], share: Float[Tensor, "R"]) -> Bool[Tensor, "R"]:
    """Return which times are near enough to the key times that boxes are there."""
    if len(boxes.key_t_s) == 1:
        return (t_s - boxes.key_t_s).abs() <= boxes.hold_s
    return (share >= -1) & (share <= 2)


def _both(present: Bool[Tensor, "A K"]) -> Bool[Tensor, "A S"]:
    return present[:, :-1] & present[:, 1:]


def crossing_pairs_reference(
    origin: Float[Tensor, "R 3"],
    direction: Float[Tensor, "R 3"],
    segment: Int[Tensor, "R"],
    share: Float[Tensor, "R"],
    boxes: MovingBoxes,
    shown: Bool[Tensor, "A S"],
) -> Int[Tensor, "P 2"]:
    """Return the crossing pairs (ray, box) in plain PyTorch: every ray with every box."""
    T = boxes.T_scene_box.detach()
    poses = torch.stack([_pose(T, a, segment, share) for a in range(len(T))], dim=1)  # [R A 4 4]
    # Rays in the frame of every box at the ray's time
    R_box_scene = poses[..., :3, :3].transpose(-1, -2)
    start = (R_box_scene @ (origin[:, None] - poses[..., :3, 3])[..., None])[..., 0]
    way = (R_box_scene @ direction[:, None, :, None])[..., 0]
    enter, leave = _span(start, way, boxes.half_size_m.detach())
    # Sort by entry; rays that miss go to the end
    crossed = (enter < leave) & shown[:, segment].T
    enter = enter.masked_fill(~crossed, torch.inf)
    order = enter.argsort(dim=1, stable=True)
    ray, place = crossed.gather(1, order).nonzero(as_tuple=True)
    return torch.stack([ray, order[ray, place]], dim=-1)


def _pose(
    T: Float[Tensor, "A K 4 4"], box: Int[Tensor, "P"] | int, segment: Int[Tensor, "P"], share: Tensor
) -> Float[Tensor, "P 4 4"]:
    """Return the poses of boxes in given segments of time."""
    # A flat index, so that the gather below is an index_select (see the module's text)
    poses, first = T.flatten(0, 1).flatten(1), box * T.shape[1] + segment
    before = poses.index_select(0, first).unflatten(1, (4, 4))
    if T.shape[1] == 1:
        return before
    after = poses.index_select(0, first + 1).unflatten(1, (4, 4))
    # Rotation turns about one fixed axis, position moves linearly
    turn = log_so3(before[:, :3, :3].transpose(-1, -2) @ after[:, :3, :3])
    turned = before @ exp_se3(torch.cat([torch.zeros_like(turn), share[:, None] * turn], dim=-1))
    moved = before[:, :, 3] + share[:, None] * (after - before)[:, :, 3]
    return torch.cat([turned[..., :3], moved[..., None]], dim=-1)


def _span(
    start: Float[Tensor, "*p 3"], way: Float[Tensor, "*p 3"], half: Float[Tensor, "*#p 3"]
) -> tuple[Float[Tensor, "*p"], Float[Tensor, "*p"]]:
    """Return the distances at which rays enter and leave boxes about the origin (enter > leave: a miss)."""
    # Parallel rays would divide by zero: their span is everything or nothing, set below
    parallel = way == 0
    way = torch.where(parallel, 1, way)
    low, high = (-half - start) / way, (half - start) / way
    outside = start.abs() > half
    near = torch.where(parallel, torch.where(outside, torch.inf, -torch.inf), torch.minimum(low, high))
    far = torch.where(parallel, torch.where(outside, -torch.inf, torch.inf), torch.maximum(low, high))
    # Intersection of the spans of three axes; the ray starts at 0
    return near.amax(-1).clamp_min(0), far.amin(-1)


def _crossings(
    pair: Int[Tensor, "P 2"],
    origin: Float[Tensor, "R 3"],
    direction: Float[Tensor, "R 3"],
    t_s: Float[Tensor, "R"],
    segment: Int[Tensor, "R"],
    boxes: MovingBoxes,
) -> Crossings:
    """Compute the distances and the rays in the boxes' frames of given pairs, differentiably."""
    # The pairs are fixed: all that follows is differentiable
    ray, box = pair.unbind(-1)
    keys, key = boxes.key_t_s, segment[ray]
    if len(keys) == 1:
        share = t_s.new_zeros(len(ray))
    else:
        share = (t_s.index_select(0, ray) - keys[key]) / (keys[key + 1] - keys[key])
    pose = _pose(boxes.T_scene_box, box, key, share)
    R_box_scene = pose[:, :3, :3].transpose(-1, -2)
    start = (R_box_scene @ (origin.index_select(0, ray) - pose[:, :3, 3])[..., None])[..., 0]
    way = (R_box_scene @ direction.index_select(0, ray)[..., None])[..., 0]
    enter, leave = _span(start, way, boxes.half_size_m[box])
    return Crossings(ray, box, enter, leave, start, way)


def _crossing_pairs(keys: KeyPoses) -> Int[Tensor, "P 2"]:
    """Return the crossing pairs (ray, box), found by the numba kernel: counted first, then written."""
    steps = int(keys.position.shape[1] > 1)
    inputs = RayBoxInputs._make([*(tensor.numpy() for tensor in keys), steps])
    rays = len(keys.origin)
    counts = torch.empty(rays, dtype=torch.int64)
    nothing = torch.empty(0, dtype=torch.int64)

    def run(starts: Tensor, ray: Tensor, box: Tensor, span: Tensor) -> None:
        arrays = [tensor.numpy() for tensor in (counts, starts, ray, box, span)]
        in_parallel(lambda start, stop: cross_rays(inputs, start, stop, *arrays), rays, grain=MIN_RAYS)

    # First pass: count the crossings of each ray, so that the second can write without gaps
    run(nothing, nothing, nothing, torch.empty(0, 2))
    starts = counts.cumsum(0) - counts
    ray, box = (torch.empty(int(counts.sum()), dtype=torch.int64) for _ in range(2))
    if len(ray):
        run(starts, ray, box, torch.empty(len(ray), 2))
    return torch.stack([ray, box], dim=-1)
