"""Sensors of the recording vehicle: six cameras similar to those of nuScenes, and a spinning lidar on the
roof."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene import CameraRig
from foredrive.sensors.lidar import SpinningLidar
from foredrive.sensors.lidar_models import hdl32e, pandar64, vlp16

_MOUNTS = {
    "PCAM_F0": ((1.70, 0.00, 1.60), 0.0, 70.0),
    "PCAM_L0": ((1.52, 0.49, 1.60), 55.0, 70.0),
    "PCAM_R0": ((1.52, -0.49, 1.60), -55.0, 70.0),
    "PCAM_L1": ((1.03, 0.48, 1.60), 110.0, 70.0),
    "PCAM_R1": ((1.03, -0.48, 1.60), -110.0, 70.0),
    "PCAM_B0": ((0.03, 0.00, 1.60), 180.0, 110.0),
}
"""Position in the ego frame (m), heading and horizontal field of view (degrees), by 123D's camera names."""
_EGO_FROM_CAM_AXES = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_LIDAR_XYZ_M = (0.94, 0.0, 1.84)
LIDARS: dict[str, Callable[[Float[Tensor, "4 4"], float], SpinningLidar]] = {
    "hdl32e": hdl32e,
    "pandar64": pandar64,
    "vlp16": vlp16,
}
"""Real lidars by name, as functions of the mounting pose and the rate of revolution, Hz."""


@dataclass(frozen=True)
class VehicleSensors:
    """The cameras and the lidar of a vehicle."""

    rig: CameraRig
    """Cameras, without leading dimensions."""
    lidar: SpinningLidar


def camera_rig(size_hw: tuple[int, int], readout_s: float = 0.0) -> CameraRig:
    """Return six cameras in all directions, without leading dimensions.

    The principal point is the image's centre.

    Rows are read from the top within `readout_s`, the middle row at the frame's time. 0: a global shutter.
    """
    height, width = size_hw
    K, T_ego_cam = [], []
    for xyz_m, heading_deg, fov_deg in _MOUNTS.values():
        focal_px = 0.5 * width / math.tan(math.radians(0.5 * fov_deg))
        K.append(torch.tensor([[focal_px, 0.0, 0.5 * width], [0.0, focal_px, 0.5 * height], [0.0, 0.0, 1.0]]))
        T_ego_cam.append(_mount(xyz_m, math.radians(heading_deg)))
    count = len(_MOUNTS)
    return CameraRig(
        K=torch.stack(K),
        T_ego_cam=torch.stack(T_ego_cam),
        dist=torch.zeros(count, 5),
        readout_s=torch.full((count,), readout_s),
        names=tuple(_MOUNTS),
        size_hw=size_hw,
    )


def roof_lidar(channels: int = 32, azimuth_steps: int = 720, rate_hz: float = 10.0) -> SpinningLidar:
    """Return a lidar with the field of view of Velodyne's HDL-32E (10.67° to -30.67°).

    Channel 0 is the lowest.
    """
    elevation_deg = torch.linspace(-30.67, 10.67, channels)
    return SpinningLidar(
        elevation_rad=tuple(elevation_deg.deg2rad().tolist()),
        azimuth_steps=azimuth_steps,
        rate_hz=rate_hz,
        min_range_m=1.0,
        max_range_m=100.0,
        range_noise_m=0.02,
        T_ego_lidar=_on_roof(),
    )


def find_lidar(name: str, rate_hz: float = 10.0) -> SpinningLidar:
    """Return a real lidar on the roof, one of `LIDARS`.

    Raises:
        InputError: there is no such lidar.
    """
    if name not in LIDARS:
        raise InputError(f"no lidar {name!r}: one of {', '.join(LIDARS)}")
    return LIDARS[name](_on_roof(), rate_hz)


def _on_roof() -> Float[Tensor, "4 4"]:
    T_ego_lidar = torch.eye(4)
    T_ego_lidar[:3, 3] = torch.tensor(_LIDAR_XYZ_M)
    return T_ego_lidar


def _mount(xyz_m: tuple[float, float, float], heading_rad: float) -> Float[Tensor, "4 4"]:
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    turn = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    T = torch.eye(4)
    T[:3, :3] = turn @ _EGO_FROM_CAM_AXES
    T[:3, 3] = torch.tensor(xyz_m)
    return T
