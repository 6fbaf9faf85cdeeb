"""The records of NAVSIM's interface at 0a380a9, as far as an agent meets them.

They stand in for NAVSIM's own where its package, or nuPlan's, cannot be imported. Agents of NAVSIM 1, whose
base class and trajectories have a sampling by default, find the same defaults.
"""

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import torch


@dataclass
class TrajectorySampling:
    """Number and times of poses, as in nuPlan's devkit: two of the three numbers give the third."""

    num_poses: int | None = None
    time_horizon: float | int | None = None
    interval_length: float | int | None = None

    def __post_init__(self) -> None:
        if self.num_poses and self.interval_length:
            self.time_horizon = self.num_poses * self.interval_length
        elif self.num_poses and self.time_horizon:
            self.interval_length = self.time_horizon / self.num_poses
        elif self.time_horizon and self.interval_length:
            self.num_poses = round(self.time_horizon / self.interval_length)
        else:
            raise ValueError("a sampling needs two of num_poses, time_horizon and interval_length")


def _four_seconds() -> TrajectorySampling:
    """Return the sampling of NAVSIM 1."""
    return TrajectorySampling(time_horizon=4, interval_length=0.5)


@dataclass
class Camera:
    """An image [H, W, 3] of 8 bits with its calibration; empty if it was not asked for."""

    image: np.ndarray | None = None
    sensor2lidar_rotation: np.ndarray | None = None
    sensor2lidar_translation: np.ndarray | None = None
    intrinsics: np.ndarray | None = None
    distortion: np.ndarray | None = None
    camera_path: Any = None


@dataclass
class Cameras:
    """The eight cameras of a key frame."""

    cam_f0: Camera
    cam_l0: Camera
    cam_l1: Camera
    cam_l2: Camera
    cam_r0: Camera
    cam_r1: Camera
    cam_r2: Camera
    cam_b0: Camera


@dataclass
class Lidar:
    """Points [6, N]: x, y, z (ego frame, m), intensity (0 to 255), ring, lidar; empty if not asked for."""

    lidar_pc: np.ndarray | None = None
    lidar_path: Any = None


@dataclass
class EgoStatus:
    """Motion of the vehicle at a key frame, in the ego frame at now."""

    ego_pose: np.ndarray
    """x, y, heading."""
    ego_velocity: np.ndarray
    ego_acceleration: np.ndarray
    driving_command: np.ndarray
    """One of left, straight, right, unknown is 1."""
    in_global_frame: bool = False


@dataclass
class AgentInput:
    """Four key frames, 0.5 s apart, the last of them now."""

    ego_statuses: list[EgoStatus]
    cameras: list[Cameras]
    lidars: list[Lidar]


@dataclass
class Trajectory:
    """Poses x, y, heading in the ego frame at now."""

    poses: np.ndarray
    trajectory_sampling: TrajectorySampling = field(default_factory=_four_seconds)

    def __post_init__(self) -> None:
        assert self.poses.shape == (self.trajectory_sampling.num_poses, 3)


@dataclass
class SensorConfig:
    """Key frames for which each sensor is loaded: a list of their numbers, all or none."""

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
    def build_all_sensors(cls, include: bool | list[int] = True) -> "SensorConfig":
        """Return a configuration that asks the same of all sensors."""
        return cls(**{field.name: include for field in fields(cls)})

    @classmethod
    def build_no_sensors(cls) -> "SensorConfig":
        """Return a configuration without sensors."""
        return cls.build_all_sensors(False)


class Scene:
    """The truth, which no agent gets here. Agents import its name for annotations."""


class AbstractFeatureBuilder:
    """Base class of what makes tensors of an `AgentInput`."""


class AbstractTargetBuilder:
    """Base class of what makes targets of training."""


class AbstractAgent(torch.nn.Module):
    """Base class of agents, as far as evaluation calls it."""

    def __init__(
        self, trajectory_sampling: TrajectorySampling | None = None, requires_scene: bool = False
    ) -> None:
        super().__init__()
        self.requires_scene = requires_scene
        self._trajectory_sampling = trajectory_sampling or _four_seconds()

    def get_feature_builders(self) -> list[Any]:
        """Return what computes the features; agents that learn have some."""
        raise NotImplementedError(f"{type(self).__name__} has neither features nor a trajectory of its own")

    def compute_trajectory(self, agent_input: AgentInput) -> Trajectory:
        """Return the prediction `trajectory` of the features that the agent's builders compute."""
        self.eval()
        features: dict[str, torch.Tensor] = {}
        for builder in self.get_feature_builders():
            features |= builder.compute_features(agent_input)
        with torch.no_grad():
            predictions = self({name: values[None] for name, values in features.items()})
        return Trajectory(predictions["trajectory"][0].numpy(), self._trajectory_sampling)


class Callback:
    """PyTorch Lightning's, for annotations."""
