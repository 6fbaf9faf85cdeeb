"""Sensor readings to compare renderings with: one image or one sweep, with pose and time in the scene."""

import dataclasses
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from foredrive.geometry.se3 import inverse_se3, log_so3, sensor_twist
from foredrive.scene import Clip, LidarSweep
from foredrive.scene.record import Record


@dataclass(frozen=True)
class CameraView(Record):
    """A camera at one exposure."""

    K: Float[Tensor, "3 3"]
    dist: Float[Tensor, "5"]
    T_scene_cam: Float[Tensor, "4 4"]
    """Pose when the middle row is exposed."""
    twist_cam: Float[Tensor, "6"]
    """Velocity (m/s), then turn rate (rad/s) of the camera over ground, in its own axes."""
    t_s: float
    """Time at which the middle row is exposed, s since the start of the drive."""
    readout_s: float
    """Time from the first to the last row, s; 0 is a global shutter."""
    size_hw: tuple[int, int]
    sensor: int
    """Index of the camera in the rig."""
    image: UInt8[Tensor, "3 H W"] | None = None

    def shrunk(self, factor: int) -> "CameraView":
        """Return the view at a lower resolution, with the image averaged."""
        height, width = self.size_hw
        # Rows and columns that do not fill a whole block scale with the rest
        size_hw = (max(height // factor, 1), max(width // factor, 1))
        if factor == 1:
            return self
        # Image coordinates start at the corner of the first pixel, so K scales without an offset
        scale = torch.tensor([size_hw[1] / width, size_hw[0] / height, 1.0]).to(self.K)
        image = self.image
        if image is not None:
            image = F.interpolate(image[None].float(), size_hw, mode="area")[0].round().to(torch.uint8)
        return dataclasses.replace(self, K=scale[:, None] * self.K, size_hw=size_hw, image=image)


@dataclass(frozen=True)
class SweepView(Record):
    """A lidar revolution: its beams in the ego frame at time `t_s`."""

    beams: LidarSweep
    """Beams to render and compare, all valid."""
    misses_known: bool
    T_scene_ego: Float[Tensor, "4 4"]
    twist_ego: Float[Tensor, "6"]
    """Velocity (m/s), then turn rate (rad/s) of the ego vehicle over ground, in its own axes."""
    t_s: float


def camera_views(
    clip: Clip, T_world_scene: Float64[Tensor, "4 4"], twists: Float[Tensor, "T 6"] | None = None
) -> list[list[CameraView]]:
    """Return the images of an unbatched clip by camera, in order of time; some may have none.

    Args:
        clip: the key frames.
        T_world_scene: maps from the scene's frame to the world.
        twists: see `ego_twists`; by default those of the clip's own frames.
    """
    T_scene_ego = _scene_poses(clip, T_world_scene)
    twists = ego_twists(clip.t_s, clip.T_world_ego) if twists is None else twists
    rig = clip.rig
    views: list[list[CameraView]] = [[] for _ in rig.names]
    for frame, camera in clip.image_valid.nonzero().tolist():
        T_ego_cam = rig.T_ego_cam[frame, camera]
        # Pose at exposure: the camera's T_ego_cam refers to the ego frame of the key frame
        late_s = 0.0 if rig.exposed_dt_s is None else float(rig.exposed_dt_s[frame, camera])
        views[camera].append(
            CameraView(
                K=rig.K[frame, camera],
                dist=rig.dist[frame, camera],
                T_scene_cam=T_scene_ego[frame] @ T_ego_cam,
                twist_cam=sensor_twist(T_ego_cam, twists[frame]),
                t_s=float(clip.t_s[frame]) + late_s,
                readout_s=float(rig.readout_s[frame, camera]),
                size_hw=rig.size_hw,
                sensor=camera,
                image=clip.images[frame, camera],
            )
        )
    return views


def sweep_views(clip: Clip, T_world_scene: Float64[Tensor, "4 4"]) -> list[SweepView]:
    """Return the sweeps of an unbatched clip in order of time."""
    T_scene_ego = _scene_poses(clip, T_world_scene)
    twists = ego_twists(clip.t_s, clip.T_world_ego)
    return [
        SweepView(
            beams=clip.sweeps[frame][clip.sweeps.valid[frame]],
            misses_known=bool(clip.misses_known[frame]),
            T_scene_ego=T_scene_ego[frame],
            twist_ego=twists[frame],
            t_s=float(clip.t_s[frame]),
        )
        for frame in clip.sweep_valid.nonzero()[:, 0].tolist()
    ]


def ego_twists(t_s: Float[Tensor, "T"], T_world_ego: Float64[Tensor, "T 4 4"]) -> Float[Tensor, "T 6"]:
    """Return velocity (m/s) and turn rate (rad/s) over ground in the ego axes, by central differences."""
    frames = len(t_s)
    if frames == 1:
        return torch.zeros(1, 6)
    # The first and last frame use one-sided differences
    before = (torch.arange(frames) - 1).clamp_min(0)
    after = (torch.arange(frames) + 1).clamp_max(frames - 1)
    span_s = (t_s[after] - t_s[before]).double()[:, None]
    # The velocity is expressed in the ego axes of the frame itself
    R_ego_world = T_world_ego[:, :3, :3].transpose(-1, -2)
    way = T_world_ego[after, :3, 3] - T_world_ego[before, :3, 3]
    velocity = (R_ego_world @ way[..., None])[..., 0]
    turn = log_so3(T_world_ego[before, :3, :3].transpose(-1, -2) @ T_world_ego[after, :3, :3])
    return (torch.cat([velocity, turn], dim=-1) / span_s).float()


def _scene_poses(clip: Clip, T_world_scene: Float64[Tensor, "4 4"]) -> Float[Tensor, "T 4 4"]:
    return (inverse_se3(T_world_scene) @ clip.T_world_ego).float()
