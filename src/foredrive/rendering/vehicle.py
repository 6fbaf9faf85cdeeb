"""The vehicle of a log: where it drove and which sensors it carried, so that a scene can be looked at without
the log.
"""

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.geometry.se3 import exp_se3, inverse_se3, sensor_twist
from foredrive.rendering.tracks import poses_at
from foredrive.scene import CameraRig, Clip
from foredrive.scene.record import Record
from foredrive.sensors import SpinningLidar

_SLACK_S = 1e-3
"""By which a time may lie outside of the drive."""


@dataclass(frozen=True)
class EgoMoment(Record):
    """The ego vehicle at one time: on its logged way, or anywhere else."""

    T_scene_ego: Float[Tensor, "4 4"]
    twist_ego: Float[Tensor, "6"]
    """Velocity (m/s), then turn rate (rad/s) over ground, in its own axes."""
    t_s: float
    """Since the drive's start: where actors are."""

    def later(self, dt_s: float) -> "EgoMoment":
        """Where it is a little later, if it goes on as it moves."""
        T_scene_ego = self.T_scene_ego @ exp_se3(dt_s * self.twist_ego)
        return EgoMoment(T_scene_ego, self.twist_ego, self.t_s + dt_s)

    def shifted(self, T_ego_shifted: Float[Tensor, "4 4"]) -> "EgoMoment":
        """A vehicle that keeps its place beside this one (`Edited.T_ego_shifted`)."""
        twist = sensor_twist(T_ego_shifted, self.twist_ego)
        return EgoMoment(self.T_scene_ego @ T_ego_shifted, twist, self.t_s)


@dataclass(frozen=True)
class Vehicle(Record):
    """What a log's vehicle carried, and where it was at K times."""

    t_s: Float[Tensor, "K"]
    """Frames of the log, since its start."""
    T_scene_ego: Float[Tensor, "K 4 4"]
    T_world_scene: Float64[Tensor, "4 4"]
    """The scene's frame, the ego frame of the first frame, in the log's world."""
    rig: CameraRig
    """[C]; `T_ego_cam` is where cameras are mounted, `exposed_dt_s` when they usually look after a frame's
    time. Their order is that of `CameraView.sensor`."""
    lidar: SpinningLidar | None
    """None where its pattern is not known."""
    T_ego_lidar: Float[Tensor, "4 4"] | None
    """Where it is; None without one."""
    reach_m: float
    """How far its lidar sees; infinite without one."""

    def check_time(self, t_s: float) -> None:
        """Raises InputError if a time lies outside of the drive."""
        first_s, last_s = float(self.t_s[0]), float(self.t_s[-1])
        if not first_s - _SLACK_S <= t_s <= last_s + _SLACK_S:
            raise InputError(f"{t_s:g} s is not in the log, which lasts from {first_s:g} s to {last_s:.1f} s")

    def at(self, t_s: float) -> EgoMoment:
        """Where the vehicle was at a time; before its first and after its last pose it goes on straight."""
        T, velocity_mps, turn_radps = poses_at(self.t_s, self.T_scene_ego[None], t_s)
        R_ego_scene = T[0, :3, :3].T
        twist = torch.cat([R_ego_scene @ velocity_mps[0], R_ego_scene @ turn_radps[0]])
        return EgoMoment(T[0], twist, t_s)

    def camera(self, name: str) -> int:
        """Which camera of the rig has a name.

        Raises:
            InputError: naming the cameras there are, if there is none of this name.
        """
        if name not in self.rig.names:
            raise InputError(f"no camera {name!r}; there are: {', '.join(self.rig.names) or 'none'}")
        return self.rig.names.index(name)


def read_vehicle(
    drive: Clip,
    T_world_scene: Float64[Tensor, "4 4"],
    lidar: SpinningLidar | None = None,
    T_ego_lidar: Float[Tensor, "4 4"] | None = None,
    reach_m: float = math.inf,
) -> Vehicle:
    """The vehicle of a whole drive.

    A camera's place is the mean over its images, each with the ego motion until its exposure taken off.

    Args:
        drive: unbatched, all its frames.
        T_world_scene, lidar, T_ego_lidar, reach_m: see `Vehicle`.
    """
    T_scene_ego = (inverse_se3(T_world_scene) @ drive.T_world_ego).float()
    rig, cameras = drive.rig, len(drive.rig.names)
    late_s = torch.zeros_like(rig.readout_s) if rig.exposed_dt_s is None else rig.exposed_dt_s
    mounted = torch.eye(4).repeat(cameras, 1, 1)
    dt_s, some = torch.zeros(cameras), [0] * cameras
    for c in range(cameras):
        frames = drive.image_valid[:, c].nonzero()[:, 0].tolist() or [0]
        exposed = [
            poses_at(drive.t_s, T_scene_ego[None], float(drive.t_s[f] + late_s[f, c]))[0][0] for f in frames
        ]
        mounted[c] = _mean_pose(
            inverse_se3(torch.stack(exposed)) @ T_scene_ego[frames] @ rig.T_ego_cam[frames, c]
        )
        dt_s[c], some[c] = late_s[frames, c].median(), frames[0]
    one = torch.arange(cameras)
    return Vehicle(
        t_s=drive.t_s,
        T_scene_ego=T_scene_ego,
        T_world_scene=T_world_scene,
        rig=CameraRig(
            K=rig.K[some, one],
            T_ego_cam=mounted,
            dist=rig.dist[some, one],
            readout_s=rig.readout_s[some, one],
            names=rig.names,
            size_hw=rig.size_hw,
            exposed_dt_s=dt_s,
        ),
        lidar=lidar,
        T_ego_lidar=T_ego_lidar,
        reach_m=reach_m,
    )


def save_vehicle(vehicle: Vehicle, path: Path) -> None:
    """Write a vehicle as JSON."""
    reach_m = vehicle.reach_m if math.isfinite(vehicle.reach_m) else None
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps({**_plain(vehicle), "reach_m": reach_m}))


def load_vehicle(path: Path) -> Vehicle:
    """Read what `save_vehicle` wrote.

    Raises:
        InputError: if there is none, or something else.
    """
    try:
        saved = json.loads(path.read_text())
        rig, lidar, mounted = saved["rig"], saved["lidar"], saved["T_ego_lidar"]
        cameras = len(rig["names"])
        return Vehicle(
            t_s=torch.tensor(saved["t_s"]),
            T_scene_ego=torch.tensor(saved["T_scene_ego"]),
            T_world_scene=torch.tensor(saved["T_world_scene"], dtype=torch.float64),
            rig=CameraRig(
                K=torch.tensor(rig["K"]).view(cameras, 3, 3),
                T_ego_cam=torch.tensor(rig["T_ego_cam"]).view(cameras, 4, 4),
                dist=torch.tensor(rig["dist"]).view(cameras, 5),
                readout_s=torch.tensor(rig["readout_s"]),
                names=tuple(rig["names"]),
                size_hw=(rig["size_hw"][0], rig["size_hw"][1]),
                exposed_dt_s=torch.tensor(rig["exposed_dt_s"]),
            ),
            lidar=None if lidar is None else _lidar(lidar),
            T_ego_lidar=None if mounted is None else torch.tensor(mounted),
            reach_m=math.inf if saved["reach_m"] is None else float(saved["reach_m"]),
        )
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, LookupError, TypeError, RuntimeError) as error:
        raise InputError(f"{path}: does not describe a vehicle: {error}") from error


def _lidar(saved: dict[str, Any]) -> SpinningLidar:
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in saved.items()
    }
    values["T_ego_lidar"] = torch.tensor(saved["T_ego_lidar"])
    return SpinningLidar(**values)


def _plain(value: Any) -> Any:
    """Records and descriptions as what JSON holds."""
    if isinstance(value, Tensor):
        return value.tolist()
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return value


def _mean_pose(T: Float[Tensor, "N 4 4"]) -> Float[Tensor, "4 4"]:
    """The mean of nearly equal poses: of rotations that which is nearest to the mean of the matrices."""
    mean = T.mean(0)
    u, _, vh = torch.linalg.svd(mean[:3, :3])
    mean[:3, :3] = u @ vh
    return mean
