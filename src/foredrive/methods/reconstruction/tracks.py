"""Tracks of actors: key poses, learnable offsets, and motion between key poses."""

import dataclasses
import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.geometry.se3 import (
    exp_se3,
    inverse_se3,
    log_so3,
    matrix_from_yaw,
    rotate_vectors,
    yaw_from_matrix,
)
from foredrive.scene import Boxes, Category, Clip
from foredrive.scene.boxes import unlabelled
from foredrive.scene.record import Record

SYMMETRIC_CATEGORIES = (
    *(Category.CAR, Category.TRUCK, Category.BUS, Category.TRAILER),
    *(Category.CONSTRUCTION_VEHICLE, Category.MOTORCYCLE, Category.BICYCLE),
)
"""Categories that are left-right symmetric."""
PER_TRACK = ("track_id", "category", "size_lwh", "T_scene_actor", "present")
"""Entries of `ActorTracks` with one row per track."""
NONRIGID_CATEGORIES = (Category.PEDESTRIAN, Category.ANIMAL)
"""Categories that change their shape while they move."""
MOVES_M = 0.5
"""Least standard deviation of the position of a moving object, m, as in NeuRAD's reference implementation."""
MAX_HOLD_S = 0.5
"""Time before and after its key time for which an actor with a single key time is present, s."""


@dataclass(frozen=True)
class ActorTracks(Record):
    """A rigid actors at K common key times, in the scene's frame. An actor's frame is that of its box."""

    track_id: Int[Tensor, "A"]
    category: Int[Tensor, "A"]
    """A `Category`."""
    size_lwh: Float[Tensor, "A 3"]
    """Length, width, height, m."""
    t_s: Float[Tensor, "K"]
    """Key times in ascending order, the same for all actors."""
    T_scene_actor: Float[Tensor, "A K 4 4"]
    present: Bool[Tensor, "A K"]
    """True where an actor is present. Elsewhere its poses are undefined."""

    def __len__(self) -> int:
        return len(self.track_id)

    @property
    def mirrored(self) -> Bool[Tensor, "A"]:
        """Return which actors are left-right symmetric."""
        return torch.isin(self.category, torch.tensor(SYMMETRIC_CATEGORIES, device=self.category.device))

    def index_of(self, track_id: int) -> int:
        """Return the row of an actor.

        Raises:
            InputError: there is no actor with this id. The message lists those that exist.
        """
        rows = (self.track_id == track_id).nonzero()
        if len(rows) == 0:
            ids = ", ".join(str(i) for i in self.track_id.tolist()) or "none"
            raise InputError(f"no actor {track_id}; there are: {ids}")
        return int(rows[0])

    def only(self, rows: Bool[Tensor, "A"] | Int[Tensor, "n"]) -> "ActorTracks":
        """Return some of the tracks, with the same key times."""
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in PER_TRACK})

    def moved(self, offset: Float[Tensor, "A K 6"]) -> "ActorTracks":
        """Return tracks with every key pose changed in the actor's frame by exp(offset): m, then rad."""
        # Multiplied from the right: offsets are in the actor's own axes
        return dataclasses.replace(self, T_scene_actor=self.T_scene_actor @ exp_se3(offset))


@dataclass(frozen=True)
class ActorStates(Record):
    """The states of A actors at one time."""

    T_scene_actor: Float[Tensor, "A 4 4"]
    velocity_mps: Float[Tensor, "A 3"]
    """Velocity of the actor's origin, in the scene's axes."""
    turn_radps: Float[Tensor, "A 3"]
    """Angular velocity, in the scene's axes."""
    present: Bool[Tensor, "A"]


def states_at(tracks: ActorTracks, t_s: float | Tensor) -> ActorStates:
    """Return all actors at a time: positions interpolated linearly, rotations about one axis.

    An actor is present between two key times if it is present at both. Before the first and after the last
    key time its motion continues for at most one step between key times. With a single key time it is static.
    The result is differentiable in the poses and in `t_s`, if that is a tensor.
    """
    now_s = float(t_s.detach()) if isinstance(t_s, Tensor) else t_s
    T, velocity_mps, turn_radps = poses_at(tracks.t_s, tracks.T_scene_actor, t_s)
    if len(tracks.t_s) == 1:
        # There is no motion to continue from a single key time, so the time alone decides
        present = tracks.present[:, 0] & (abs(float(tracks.t_s[0]) - now_s) <= MAX_HOLD_S)
    else:
        after = _key_after(tracks.t_s, now_s)
        step_s = float(tracks.t_s[after] - tracks.t_s[after - 1])
        # At most one step before the first or after the last key time
        near = -1.0 <= (now_s - float(tracks.t_s[after - 1])) / step_s <= 2.0
        present = tracks.present[:, after - 1] & tracks.present[:, after] & near
    return ActorStates(T, velocity_mps, turn_radps, present)


def poses_at(
    key_t_s: Float[Tensor, "K"], T: Float[Tensor, "A K 4 4"], t_s: float | Tensor
) -> tuple[Float[Tensor, "A 4 4"], Float[Tensor, "A 3"], Float[Tensor, "A 3"]]:
    """Return poses at a time, with velocities (m/s) and turn rates (rad/s) in the axes of their frame.

    Positions are interpolated linearly between key poses, rotations about one axis. Before the first and
    after the last key time the motion continues. A single key pose is static. The result is differentiable in
    `T` and `t_s`.
    """
    if len(key_t_s) == 1:
        still = torch.zeros(len(T), 3).to(T)
        return T[:, 0], still, still
    after = _key_after(key_t_s, float(t_s.detach()) if isinstance(t_s, Tensor) else t_s)
    step_s = float(key_t_s[after] - key_t_s[after - 1])
    # Share of the step that has passed; below 0 or above 1 outside of the key times
    share = (t_s - float(key_t_s[after - 1])) / step_s
    T0, T1 = T[:, after - 1], T[:, after]
    turn = log_so3(T0[:, :3, :3].transpose(-1, -2) @ T1[:, :3, :3])  # in the actor's own axes
    # Rotate by a share of the turn, about the axis from the first to the second pose
    now = T0 @ exp_se3(torch.cat([torch.zeros_like(turn), share * turn], dim=-1))
    # The translation column is interpolated apart from the rotation, in the scene's axes
    now = torch.cat([now[..., :3], now[..., 3:] + share * (T1 - T0)[..., 3:]], dim=-1)
    way = T1[:, :3, 3] - T0[:, :3, 3]
    # The turn is in the actor's own axes: rotate it to the axes of the frame
    return now, way / step_s, (T0[:, :3, :3] @ turn[..., None])[..., 0] / step_s


def _key_after(key_t_s: Float[Tensor, "K"], now_s: float) -> int:
    """Return the index of the later of the two key times around, or nearest to, a time."""
    # searchsorted gives the first key time that is not before now; the ends use their only interval
    after = int(torch.searchsorted(key_t_s.contiguous(), now_s))
    return min(max(after, 1), len(key_t_s) - 1)


def boxes_at(
    tracks: ActorTracks, T_scene_ego: Float[Tensor, "4 4"], t_s: float, within_m: float = math.inf
) -> Boxes:
    """Return the boxes of actors present at a time, in the ego frame, unbatched."""
    states = states_at(tracks, t_s)
    T_ego_scene = inverse_se3(T_scene_ego)
    T_ego_actor = T_ego_scene @ states.T_scene_actor.to(T_scene_ego)
    velocity = rotate_vectors(T_ego_scene, states.velocity_mps.to(T_scene_ego))
    near = states.present & (T_ego_actor[:, :3, 3].norm(dim=-1) < within_m)
    return Boxes(
        centre=T_ego_actor[near, :3, 3].float(),
        size_lwh=tracks.size_lwh[near],
        yaw=yaw_from_matrix(T_ego_actor)[near].float(),
        velocity=velocity[near, :2].float(),
        track_id=tracks.track_id[near],
        category=tracks.category[near],
        valid=torch.ones_like(tracks.track_id[near], dtype=torch.bool),
        **unlabelled(int(near.sum()), device=near.device),
    )


def joined_tracks(tracks: ActorTracks, others: ActorTracks) -> ActorTracks:
    """Return the tracks of both, which have the same key times."""
    pairs = {name: (getattr(tracks, name), getattr(others, name)) for name in PER_TRACK}
    return dataclasses.replace(tracks, **{name: torch.cat([a, b.to(a)]) for name, (a, b) in pairs.items()})


def move_at_least(tracks: ActorTracks, std_m: float) -> Bool[Tensor, "A"]:
    """Return which tracks move: in some direction the standard deviation of their position is greater.

    NeuRAD's reference implementation finds the moving objects of nuScenes in this way, along the axes of the
    map. For PandaSet it uses the dataset's own marks of standing objects; cuboids with that mark keep their
    place exactly.
    """
    # Absent frames are zeros and count nothing
    present = tracks.present[..., None]
    xy_m = tracks.T_scene_actor[..., :2, 3].detach().double() * present
    count = present.sum(1)
    # Deviations from the mean position; masked again, since the mean was subtracted from absent frames too
    spread_m = (xy_m - (xy_m.sum(1) / count.clamp_min(1))[:, None]) * present
    covariance = spread_m.mT @ spread_m / (count - 1).clamp_min(1)[..., None]
    # The largest eigenvalue is the variance along the direction of most motion
    return torch.linalg.eigvalsh(covariance)[:, -1] > std_m**2


def split_tracks(
    tracks: ActorTracks, moves_m: float = MOVES_M, nonrigid: bool = True
) -> tuple[ActorTracks, ActorTracks]:
    """Return the tracks of the actors, parts of their own, and those of what belongs to the static part.

    Args:
        tracks: all tracks of a log.
        moves_m: an actor's least standard deviation of its position (`move_at_least`), m; 0: all are actors.
        nonrigid: whether pedestrians and animals are actors.
    """
    actors = move_at_least(tracks, moves_m) if moves_m else torch.ones_like(tracks.present[:, 0])
    if not nonrigid:
        actors &= ~nonrigid_rows(tracks)
    return tracks.only(actors), tracks.only(~actors)


def nonrigid_rows(tracks: ActorTracks) -> Bool[Tensor, "A"]:
    """Return which actors change their shape while they move."""
    return torch.isin(tracks.category, torch.tensor(NONRIGID_CATEGORIES, device=tracks.category.device))


def read_tracks(clip: Clip, T_world_scene: Float64[Tensor, "4 4"]) -> ActorTracks:
    """Read the tracks of an unbatched clip in the scene's frame. Key times are those of its frames.

    Gaps between two detections are filled by interpolation. An actor is kept for one frame before its first
    and after its last detection, with continued motion.
    """
    boxes = clip.boxes
    T_scene_ego = (inverse_se3(T_world_scene) @ clip.T_world_ego).float()
    # Boxes turn about the z axis of the ego frame of their time
    T_scene_box = T_scene_ego[:, None] @ matrix_from_yaw(boxes.yaw, boxes.centre)
    seen = boxes.valid & clip.boxes_valid[:, None]
    ids = boxes.track_id[seen].unique()
    frames = len(clip.t_s)
    poses = torch.eye(4).repeat(len(ids), frames, 1, 1)
    present = torch.zeros(len(ids), frames, dtype=torch.bool)
    size, category = torch.zeros(len(ids), 3), torch.zeros(len(ids), dtype=torch.int64)
    for a, track_id in enumerate(ids):
        # Frames and slots of this track; a track has at most one box per frame
        t, m = (seen & (boxes.track_id == track_id)).nonzero(as_tuple=True)
        poses[a, t], present[a, t] = T_scene_box[t, m], True
        # Median size and most frequent category over all detections
        size[a] = boxes.size_lwh[t, m].median(0).values
        category[a] = boxes.category[t, m].mode().values
    return _filled(ActorTracks(ids, category, size, clip.t_s, poses, present))


def _filled(tracks: ActorTracks) -> ActorTracks:
    """Fill the poses between an actor's detections and at one key time around them."""
    poses, present = tracks.T_scene_actor.clone(), tracks.present.clone()
    for a in range(len(tracks)):
        keys = tracks.present[a].nonzero()[:, 0]
        one = slice(a, a + 1)
        sightings = ActorTracks(
            tracks.track_id[one],
            tracks.category[one],
            tracks.size_lwh[one],
            tracks.t_s[keys],
            tracks.T_scene_actor[one, keys],
            tracks.present[one, keys],
        )
        # From one frame before the first detection to one after the last
        for k in range(max(int(keys[0]) - 1, 0), min(int(keys[-1]) + 2, len(tracks.t_s))):
            if not tracks.present[a, k]:
                # Interpolated or continued from the detections alone, not from other filled poses
                poses[a, k] = states_at(sightings, float(tracks.t_s[k])).T_scene_actor[0]
                present[a, k] = True
    return dataclasses.replace(tracks, T_scene_actor=poses, present=present)
