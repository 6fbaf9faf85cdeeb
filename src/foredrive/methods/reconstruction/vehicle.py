"""The vehicle of a log: its path and sensors, so that a scene can be rendered without the log."""

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
from foredrive.methods.reconstruction.tracks import poses_at
from foredrive.scene import CameraRig, Clip
from foredrive.scene.record import Record
from foredrive.sensors import SpinningLidar

_SLACK_S = 1e-3
"""Tolerance for times outside of the drive, s."""


@dataclass(frozen=True)
class EgoState(Record):
    """The ego vehicle at one time, on its logged path or anywhere else."""

    T_scene_ego: Float[Tensor, "4 4"]
    twist_ego: Float[Tensor, "6"]
    """Velocity (m/s), then turn rate (rad/s) over ground, in its own axes."""
    t_s: float
    """Seconds since the start of the drive; sets the actors' positions."""

    def later(self, dt_s: float) -> "EgoState":
        """Return the vehicle after `dt_s` of constant motion."""
        T_scene_ego = self.T_scene_ego @ exp_se3(dt_s * self.twist_ego)
        return EgoState(T_scene_ego, self.twist_ego, self.t_s + dt_s)

    def shifted(self, T_ego_shifted: Float[Tensor, "4 4"]) -> "EgoState":
        """Return a vehicle at a fixed pose relative to this one (`EditedScene.T_ego_shifted`)."""
        twist = sensor_twist(T_ego_shifted, self.twist_ego)
        return EgoState(self.T_scene_ego @ T_ego_shifted, twist, self.t_s)


@dataclass(frozen=True)
class LoggedVehicle(Record):
    """The sensors of a log's vehicle and its poses at K times."""

    t_s: Float[Tensor, "K"]
    """Times of the log's frames, s since its start."""
    T_scene_ego: Float[Tensor, "K 4 4"]
    T_world_scene: Float64[Tensor, "4 4"]
    """The frame of the scene (the ego frame of the first log frame) in the log's world."""
    rig: CameraRig
    """[C]; `T_ego_cam` is the mount of each camera, `exposed_dt_s` its usual delay after a frame's time. The
    order is that of `CameraView.sensor`."""
    lidar: SpinningLidar | None
    """None if its pattern is unknown."""
    T_ego_lidar: Float[Tensor, "4 4"] | None
    """Mount of the lidar; None without one."""
    reach_m: float
    """Range of the lidar, m; infinite without one."""
    other_names: tuple[tuple[str, ...], ...] = ()
    """Further names of each camera, such as those in 123D; empty if none are known."""
    learned: tuple[int, ...] = ()
    """Index of the log's camera whose learned colours and corrections each camera takes. Empty: its own."""

    def with_rig(self, rig: CameraRig) -> "LoggedVehicle":
        """Return the vehicle with other cameras. Each takes what was learned of the most similar one."""
        axes, logged = rig.T_ego_cam[:, :3, 2], self.rig.T_ego_cam[:, :3, 2]
        turned_rad = (axes @ logged.T).clamp(-1, 1).acos()
        # Fields of view, as focal lengths in image widths
        focal, of_log = (one.K[:, 0, 0] / one.size_hw[1] for one in (rig, self.rig))
        alike = turned_rad + (focal[:, None] / of_log).log().abs()
        chosen = alike.argmin(1).tolist()
        learned = tuple(self.learned[k] if self.learned else k for k in chosen)
        return dataclasses.replace(self, rig=rig, other_names=(), learned=learned)

    def check_time(self, t_s: float) -> None:
        """Check that a time lies within the drive.

        Raises:
            InputError: it does not.
        """
        first_s, last_s = float(self.t_s[0]), float(self.t_s[-1])
        if not first_s - _SLACK_S <= t_s <= last_s + _SLACK_S:
            raise InputError(f"{t_s:g} s is not in the log, which lasts from {first_s:g} s to {last_s:.1f} s")

    def at(self, t_s: float) -> EgoState:
        """Return the vehicle at a time. Before its first and after its last pose the motion continues."""
        T, velocity_mps, turn_radps = poses_at(self.t_s, self.T_scene_ego[None], t_s)
        # Velocities to the vehicle's own axes
        R_ego_scene = T[0, :3, :3].T
        twist = torch.cat([R_ego_scene @ velocity_mps[0], R_ego_scene @ turn_radps[0]])
        return EgoState(T[0], twist, t_s)

    def camera(self, name: str) -> int:
        """Return the index of a camera in the rig, by any of its names in any case.

        Raises:
            InputError: there is no camera of this name. The message lists those that exist.
        """
        others = self.other_names or ((),) * len(self.rig.names)
        cameras = [dict.fromkeys((own, *names)) for own, names in zip(self.rig.names, others, strict=True)]
        for index, names in enumerate(cameras):
            if name.lower() in (alias.lower() for alias in names):
                return index
        texts = [own if not names else f"{own} ({', '.join(names)})" for own, *names in cameras]
        raise InputError(f"no reconstructed camera {name!r}; there are: {', '.join(texts) or 'none'}")


def read_vehicle(
    drive: Clip,
    T_world_scene: Float64[Tensor, "4 4"],
    lidar: SpinningLidar | None = None,
    T_ego_lidar: Float[Tensor, "4 4"] | None = None,
    reach_m: float = math.inf,
) -> LoggedVehicle:
    """Read the vehicle of a whole drive.

    The mount of a camera is the mean over its images, after the ego motion until each exposure is removed.

    Args:
        drive: unbatched, with all frames.
        T_world_scene, lidar, T_ego_lidar, reach_m: see `LoggedVehicle`.
    """
    T_scene_ego = (inverse_se3(T_world_scene) @ drive.T_world_ego).float()
    rig, cameras = drive.rig, len(drive.rig.names)
    # Without logged delays, images are taken at the time of their frame
    late_s = torch.zeros_like(rig.readout_s) if rig.exposed_dt_s is None else rig.exposed_dt_s
    mounted = torch.eye(4).repeat(cameras, 1, 1)
    dt_s, some = torch.zeros(cameras), [0] * cameras
    for c in range(cameras):
        frames = drive.image_valid[:, c].nonzero()[:, 0].tolist() or [0]
        # Pose of the vehicle when each image was exposed
        exposed = [
            poses_at(drive.t_s, T_scene_ego[None], float(drive.t_s[f] + late_s[f, c]))[0][0] for f in frames
        ]
        mounted[c] = _mean_pose(
            # Mount seen from the vehicle at exposure: `T_ego_cam` of a
            # frame contains the motion until exposure
            inverse_se3(torch.stack(exposed)) @ T_scene_ego[frames] @ rig.T_ego_cam[frames, c]
        )
        # Intrinsics are those of the first valid frame
        dt_s[c], some[c] = late_s[frames, c].median(), frames[0]
    one = torch.arange(cameras)
    return LoggedVehicle(
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


def save_vehicle(vehicle: LoggedVehicle, path: Path) -> None:
    """Write a vehicle as JSON."""
    # JSON has no infinity
    reach_m = vehicle.reach_m if math.isfinite(vehicle.reach_m) else None
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps({**_plain(vehicle), "reach_m": reach_m}))


def load_vehicle(path: Path) -> LoggedVehicle:
    """Read a file written by `save_vehicle`.

    Raises:
        InputError: the file cannot be read or does not describe a vehicle.
    """
    try:
        saved = json.loads(path.read_text())
        rig, lidar, mounted = saved["rig"], saved["lidar"], saved["T_ego_lidar"]
        cameras = len(rig["names"])
        return LoggedVehicle(
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
            other_names=tuple(tuple(map(str, names)) for names in saved.get("other_names", [])),
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
    """Convert records to values that JSON can hold."""
    if isinstance(value, Tensor):
        return value.tolist()
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return value


def _mean_pose(T: Float[Tensor, "N 4 4"]) -> Float[Tensor, "4 4"]:
    """Return the mean of nearly equal poses. Its rotation is the one nearest to the mean of the matrices."""
    # The mean of rotations is not a rotation: project it onto the nearest one by SVD
    mean = T.mean(0)
    u, _, vh = torch.linalg.svd(mean[:3, :3])
    mean[:3, :3] = u @ vh
    return mean
