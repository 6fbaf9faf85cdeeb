"""The records of NAVSIM's interface at 0a380a9, as far as an agent meets them."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch


@dataclass
class TrajectorySampling:
    """Of nuPlan's devkit: the times of poses."""

    num_poses: int = 8
    interval_length: float = 0.5


class AbstractAgent(torch.nn.Module):
    """NAVSIM's base class at 0a380a9, as far as its evaluation calls it."""

    def __init__(self, trajectory_sampling: TrajectorySampling, requires_scene: bool = False) -> None:
        super().__init__()
        self.requires_scene = requires_scene
        self._trajectory_sampling = trajectory_sampling


@dataclass
class Camera:
    image: np.ndarray | None = None
    sensor2lidar_rotation: np.ndarray | None = None
    sensor2lidar_translation: np.ndarray | None = None
    intrinsics: np.ndarray | None = None
    distortion: np.ndarray | None = None


@dataclass
class Cameras:
    cam_f0: Camera
    cam_l0: Camera
    cam_l1: Camera
    cam_l2: Camera
    cam_r0: Camera
    cam_r1: Camera
    cam_r2: Camera
    cam_b0: Camera


@dataclass
class EgoStatus:
    ego_pose: np.ndarray
    ego_velocity: np.ndarray
    ego_acceleration: np.ndarray
    driving_command: np.ndarray


@dataclass
class AgentInput:
    ego_statuses: list[EgoStatus]
    cameras: list[Cameras]
    lidars: list[Any]


@dataclass
class Trajectory:
    poses: np.ndarray
    trajectory_sampling: TrajectorySampling

    def __post_init__(self) -> None:
        assert self.poses.shape == (self.trajectory_sampling.num_poses, 3)


@dataclass
class SensorConfig:
    cam_f0: bool | list[int]
    cam_l0: bool | list[int]
    cam_l1: bool | list[int]
    cam_l2: bool | list[int]
    cam_r0: bool | list[int]
    cam_r1: bool | list[int]
    cam_r2: bool | list[int]
    cam_b0: bool | list[int]
    lidar_pc: bool | list[int]

    @classmethod
    def build_no_sensors(cls) -> "SensorConfig":
        return cls(**{field.name: False for field in fields(cls)})
