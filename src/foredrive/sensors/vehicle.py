"""Sensors of the recording vehicle: a camera rig, and a spinning lidar on the roof."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene import CameraRig
from foredrive.sensors.lidar import SpinningLidar
from foredrive.sensors.lidar_models import hdl32e, pandar64, vlp16

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
    lidar: SpinningLidar | None
    """None: there is none, and nothing is spent on it."""


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
