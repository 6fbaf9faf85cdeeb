"""The clip: the input of every part of Foredrive."""

import dataclasses
import enum
import functools
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int, UInt8
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene.boxes import Boxes
from foredrive.scene.map_patch import MapPatch
from foredrive.scene.record import Record
from foredrive.scene.rig import CameraRig
from foredrive.scene.sweep import LidarSweep
from foredrive.scene.task_truth import TaskTruth
from foredrive.scene.trajectory import Trajectory
from foredrive.scene.voxels import VoxelGrid

NOW_TOLERANCE_S = 1e-4
ROUTE_M = (2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0)
"""Distances along the route of the points that an agent is given, m."""
TARGET = ROUTE_M.index(20.0)
"""The one of these points that agents with a single target point are given, as on CARLA's leaderboards."""


class Command(enum.IntEnum):
    """Direction in which the route continues."""

    LEFT = 0
    RIGHT = 1
    STRAIGHT = 2


@dataclass(frozen=True)
class Clip(Record):
    """Key frames of one drive: sensor data up to now, and the future for training and evaluation.

    Frames are ordered in time. `t_s` is 0 at now, negative before it and positive after it. Now has the same
    index in the whole batch. Data that a log lacks are masked (`*_valid`), never invented. Masked entries are
    0.
    """

    t_s: Float[Tensor, "*b T"]
    """Time of each key frame relative to now, s."""
    T_world_ego: Float64[Tensor, "*b T 4 4"]
    """ego (x forward, y left, z up, origin at the rear axle on the ground) -> world. Double precision,
    because world coordinates are large."""
    images: UInt8[Tensor, "*b T C 3 H W"]
    """RGB."""
    image_valid: Bool[Tensor, "*b T C"]
    rig: CameraRig
    """Leading dimensions [b T]."""
    sweeps: LidarSweep
    """Leading dimensions [b T]. N is 0 when no lidar was requested."""
    sweep_valid: Bool[Tensor, "*b T"]
    misses_known: Bool[Tensor, "*b T"]
    """Whether a sweep includes the beams that did not return."""
    boxes: Boxes
    """Leading dimensions [b T]. Each box is in the ego frame of its own time step."""
    boxes_valid: Bool[Tensor, "*b T"]
    """True if the frame is annotated. An annotated frame may have no boxes."""
    ego_speed_mps: Float[Tensor, "*b T"]
    ego_speed_valid: Bool[Tensor, "*b T"]
    command: Int[Tensor, "*b"]
    """The `Command` at now."""
    command_valid: Bool[Tensor, "*b"]
    route_xy: Float[Tensor, "*b R 2"]
    """Route points at the distances `ROUTE_M` from the point beside the vehicle, in the ego frame at now, m.
    Those beyond the end of the route are its end."""
    route_valid: Bool[Tensor, "*b R"]
    """False for points beyond the end of the route, and for all where no route was given."""
    future: Trajectory
    """The recorded future (M = 1): target of training and evaluation, hidden from the agent."""
    map: MapPatch | None = None

    @functools.cached_property
    def now(self) -> int:
        """The index of the frame at t = 0. It is read once: each read of a clip on a GPU would wait for it.

        Raises:
            InputError: no single frame is at t = 0, or its index differs within the batch.
        """
        # Every row of the batch must have exactly one frame at t = 0, at the same index
        t_s = self.t_s.cpu()
        at_now = t_s.reshape(-1, t_s.shape[-1]).abs() <= NOW_TOLERANCE_S
        if not bool((at_now == at_now[:1]).all()) or int(at_now[0].sum()) != 1:
            raise InputError(f"a clip needs one frame at t = 0, the same for the batch, got t_s = {t_s}")
        return int(at_now[0].nonzero().item())

    def frames(self, index: slice | list[int]) -> "Clip":
        """Return the clip with a subset of its frames."""
        batch_dims = self.t_s.dim() - 1
        where = (slice(None),) * batch_dims + (index,)
        per_frame = (
            "t_s T_world_ego images image_valid rig sweeps sweep_valid misses_known boxes boxes_valid "
            "ego_speed_mps ego_speed_valid"
        )
        return dataclasses.replace(self, **{name: getattr(self, name)[where] for name in per_frame.split()})

    def through(self, cameras: list[int]) -> "Clip":
        """Return the clip with a subset of its cameras, in the given order."""
        where = (slice(None),) * self.t_s.dim() + (cameras,)
        rig = dataclasses.replace(self.rig[where], names=tuple(self.rig.names[k] for k in cameras))
        return dataclasses.replace(
            self, images=self.images[where], image_valid=self.image_valid[where], rig=rig
        )

    def observed(self) -> "Clip":
        """Return the part that an agent may see: frames up to now, with the future masked."""
        past = self.frames(slice(0, self.now + 1))
        unknown = dataclasses.replace(
            self.future,
            xy=torch.zeros_like(self.future.xy),
            yaw=torch.zeros_like(self.future.yaw),
            valid=torch.zeros_like(self.future.valid),
        )
        return dataclasses.replace(past, future=unknown)


@dataclass(frozen=True)
class Example(Record):
    """A clip and its voxel labels: one item of training and evaluation."""

    clip: Clip
    occupancy: VoxelGrid
    """[b T 1 Z Y X]: 1 is occupied, 0 is free, defined where `known`. Each frame is in its own ego frame."""
    flow: VoxelGrid
    """[b T 3 Z Y X]: velocity over ground of the content of a voxel, in the ego axes of its frame, m/s. Known
    where the log has tracks and the voxel is occupied."""
    key: tuple[str, ...]
    """Log name and time of now for each item of the batch. Errors and reports show it."""
    truth: TaskTruth | None = None
    """Ground truth of further tasks at now. None if it was not asked for."""
