"""An agent of NAVSIM's interface, driven by Foredrive: clips become its input, its poses a plan."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64

from foredrive.driving.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.errors import InputError
from foredrive.integrations.navsim.stand_ins import RECORDS
from foredrive.scene import Clip, Command

HISTORY = 4
"""Number of key frames that NAVSIM gives, the last of them now."""
IMAGE_HW = (1080, 1920)
"""Size of nuPlan's images, which agents of NAVSIM crop by the pixel."""
COMMANDS = (Command.LEFT, Command.STRAIGHT, Command.RIGHT)
"""NAVSIM's driving command is one of four; the fourth is "unknown"."""


def sensors_of(agent: Any) -> tuple[tuple[str, ...], bool]:
    """Return 123D's names of the cameras that an agent asks for at any key frame, and whether for lidar.

    Raises:
        InputError: it wants the true scene, as NAVSIM's human agent does.
    """
    if getattr(agent, "requires_scene", False):
        raise InputError(f"{type(agent).__name__} asks for the true scene, which no agent gets")
    asked = [name for name, frames in vars(agent.get_sensor_config()).items() if frames]
    return tuple(f"P{name.upper()}" for name in asked if name.startswith("cam_")), "lidar_pc" in asked


@dataclass(eq=False)
class NavsimPlanner:
    """An agent of NAVSIM's interface in one drive. It remembers the commands of the drive.

    A clip has the command of now alone, and NAVSIM's input that of each key frame.
    """

    agent: Any
    _commands: dict[bytes, Int64[np.ndarray, "4"]] = field(default_factory=dict, init=False)
    """Commands by the poses at which they were given."""

    def plan(self, clip: Clip) -> Float[np.ndarray, "T 2"]:
        """Return the points of the agent's plan, see `plan_by_navsim`."""
        poses = [T.tobytes() for T in clip.T_world_ego.numpy()]
        self._commands[poses[clip.now]] = now = _command_of(clip)
        # Key frames before the drive have the first command that is known
        first = next((self._commands[pose] for pose in poses if pose in self._commands), now)
        return plan_by_navsim(self.agent, clip, [self._commands.get(pose, first) for pose in poses])


def plan_by_navsim(
    agent: Any, clip: Clip, commands: Sequence[Int64[np.ndarray, "4"]]
) -> Float[np.ndarray, "T 2"]:
    """Return the points of an agent's plan at multiples of 0.5 s, linear between its poses.

    Args:
        agent: an object of NAVSIM's interface.
        clip: what it sees.
        commands: NAVSIM's command at each key frame.

    Raises:
        InputError: the plan is shorter than 3 s.
    """
    with torch.no_grad():
        answer = agent.compute_trajectory(input_of(agent, clip, commands))
    dt_s = float(answer.trajectory_sampling.interval_length)
    xy = np.concatenate([np.zeros((1, 2)), np.asarray(answer.poses, dtype=np.float64)[:, :2]])
    t_s, wanted_s = dt_s * np.arange(len(xy)), FRAME_DT_S * np.arange(1, HORIZON_STEPS + 1)
    if t_s[-1] < wanted_s[-1] - 1e-6:
        raise InputError(f"a plan of {t_s[-1]:g} s; plans are of {wanted_s[-1]:g} s or more")
    return np.stack([np.interp(wanted_s, t_s, xy[:, axis]) for axis in range(2)], axis=1)


def _command_of(clip: Clip) -> Int64[np.ndarray, "4"]:
    command = np.zeros(len(COMMANDS) + 1, dtype=np.int64)
    command[COMMANDS.index(Command(int(clip.command))) if clip.command_valid else -1] = 1
    return command


def input_of(agent: Any, clip: Clip, commands: Sequence[Int64[np.ndarray, "4"]]) -> Any:
    """Return a clip of four key frames as NAVSIM's `AgentInput`.

    nuPlan's merged lidar is in the ego frame, so `sensor2lidar` is the place of a camera in the ego frame.
    """
    records, config = sys.modules[RECORDS], vars(agent.get_sensor_config())
    T_now = torch.linalg.inv(clip.T_world_ego[clip.now]) @ clip.T_world_ego
    yaw, speed = torch.atan2(T_now[:, 1, 0], T_now[:, 0, 0]), clip.ego_speed_mps.double()
    statuses, cameras, lidars = [], [], []
    for frame in range(len(clip.t_s)):
        # Rates since the frame before; the first frame has those of the second
        after = max(frame, 1)
        dt_s = float(clip.t_s[after] - clip.t_s[after - 1])
        turn_rate = float(yaw[after] - yaw[after - 1]) / dt_s
        gain = float(speed[after] - speed[after - 1]) / dt_s
        pose = [*T_now[frame, :2, 3].tolist(), float(yaw[frame])]
        statuses.append(
            records.EgoStatus(
                ego_pose=np.array(pose, dtype=np.float32),
                ego_velocity=np.array([speed[frame], 0.0], dtype=np.float32),
                ego_acceleration=np.array([gain, float(speed[frame]) * turn_rate], dtype=np.float32),
                driving_command=commands[frame],
            )
        )
        shown = {
            name: _camera(records, clip, frame, name) if _asked(config[name], frame) else records.Camera()
            for name in config
            if name.startswith("cam_")
        }
        cameras.append(records.Cameras(**shown))
        lidar = records.Lidar()
        if _asked(config["lidar_pc"], frame):
            lidar.lidar_pc = _points(clip, frame)
        lidars.append(lidar)
    return records.AgentInput(statuses, cameras, lidars)


def _asked(frames: bool | list[int], frame: int) -> bool:
    return frames if isinstance(frames, bool) else frame in frames


def _camera(records: Any, clip: Clip, frame: int, name: str) -> Any:
    camera = [own.lower() for own in clip.rig.names].index(f"p{name}")
    T_ego_cam = clip.rig.T_ego_cam[frame, camera].numpy()
    return records.Camera(
        image=clip.images[frame, camera].permute(1, 2, 0).numpy(),
        sensor2lidar_rotation=T_ego_cam[:3, :3],
        sensor2lidar_translation=T_ego_cam[:3, 3],
        intrinsics=clip.rig.K[frame, camera].numpy(),
        distortion=clip.rig.dist[frame, camera].numpy(),
    )


def _points(clip: Clip, frame: int) -> Float[np.ndarray, "6 N"]:
    sweep = clip.sweeps[frame]
    sweep = sweep[sweep.valid & sweep.returned]
    lidar = torch.zeros_like(sweep.intensity)
    columns = [*sweep.points_ego.T, 255.0 * sweep.intensity, sweep.beam.clamp(min=0).float(), lidar]
    return torch.stack(columns).numpy()
