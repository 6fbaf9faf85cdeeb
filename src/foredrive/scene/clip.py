"""The one thing every part of Foredrive reads."""

import dataclasses
import enum
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
from foredrive.scene.trajectory import Trajectory
from foredrive.scene.voxels import VoxelGrid

NOW_TOLERANCE_S = 1e-4


class Command(enum.IntEnum):
    """Where the route leads next."""

    LEFT = 0
    RIGHT = 1
    STRAIGHT = 2


@dataclass(frozen=True)
class Clip(Record):
    """Key frames of one drive: what was sensed up to now and, for training and scoring, what came after.

    Frames are ordered in time; `t_s` is 0 at now, negative before it, positive after it, and now is at the
    same index for the whole batch. Whatever a log lacks is masked (`*_valid`), never invented; masked
    entries hold zeros.
    """

    t_s: Float[Tensor, "*b T"]
    """Time of each key frame relative to now, s."""
    T_world_ego: Float64[Tensor, "*b T 4 4"]
    """ego (x forward, y left, z up, rear axle on the ground) -> world; double precision: worlds are large."""
    images: UInt8[Tensor, "*b T C 3 H W"]
    """RGB."""
    image_valid: Bool[Tensor, "*b T C"]
    rig: CameraRig
    """Leading dimensions [b T]."""
    sweeps: LidarSweep
    """Leading dimensions [b T]; N may be 0 when lidar was not asked for."""
    sweep_valid: Bool[Tensor, "*b T"]
    misses_known: Bool[Tensor, "*b T"]
    """Whether a sweep holds the beams that did not return."""
    boxes: Boxes
    """Leading dimensions [b T], in the ego frame of their own time step."""
    boxes_valid: Bool[Tensor, "*b T"]
    """Whether the frame is annotated (no boxes and no annotation are two things)."""
    ego_speed_mps: Float[Tensor, "*b T"]
    ego_speed_valid: Bool[Tensor, "*b T"]
    command: Int[Tensor, "*b"]
    """A `Command`, at now."""
    command_valid: Bool[Tensor, "*b"]
    target_xy: Float[Tensor, "*b 2"]
    """Where the route is 20 m on from beside the vehicle (`data.commands.LOOKAHEAD_M`), in the ego frame at
    now, m: what CARLA's global plan tells an agent beyond the command."""
    target_valid: Bool[Tensor, "*b"]
    future: Trajectory
    """The driven future (M = 1): what an agent is trained and judged on, and must not see."""
    map: MapPatch | None = None

    @property
    def now(self) -> int:
        """Index of the frame at t = 0."""
        at_now = self.t_s.reshape(-1, self.t_s.shape[-1]).abs() <= NOW_TOLERANCE_S
        if not bool((at_now == at_now[:1]).all()) or int(at_now[0].sum()) != 1:
            raise InputError(f"a clip needs one frame at t = 0, the same for the batch, got t_s = {self.t_s}")
        return int(at_now[0].nonzero().item())

    def frames(self, index: slice | list[int]) -> "Clip":
        """The clip with some of its frames only."""
        batch_dims = self.t_s.dim() - 1
        where = (slice(None),) * batch_dims + (index,)
        per_frame = (
            "t_s T_world_ego images image_valid rig sweeps sweep_valid misses_known boxes boxes_valid "
            "ego_speed_mps ego_speed_valid"
        )
        return dataclasses.replace(self, **{name: getattr(self, name)[where] for name in per_frame.split()})

    def through(self, cameras: list[int]) -> "Clip":
        """The clip with some of its cameras only, in this order."""
        where = (slice(None),) * self.t_s.dim() + (cameras,)
        rig = dataclasses.replace(self.rig[where], names=tuple(self.rig.names[k] for k in cameras))
        return dataclasses.replace(
            self, images=self.images[where], image_valid=self.image_valid[where], rig=rig
        )

    def observed(self) -> "Clip":
        """What an agent may see: frames up to now, the future masked."""
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
    """A clip with the voxel labels made from its raw data: one item of training and of evaluation."""

    clip: Clip
    occupancy: VoxelGrid
    """[b T 1 Z Y X]: 1 occupied, 0 free where `known`; each frame in its own ego frame."""
    flow: VoxelGrid
    """[b T 3 Z Y X]: velocity over ground of what occupies a voxel, in the ego axes of its frame, m/s;
    known where the log has tracks and the voxel is occupied."""
    key: tuple[str, ...]
    """Log name and time of now, one per item of the batch: names the item in errors and reports."""
