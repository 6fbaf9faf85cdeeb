"""Messages of neuro-ncap's model server: what a planner is sent, and what it answers.

Source: public repository atonderski/neuro-ncap at ecdcf28, `components/model_api.py`, `engine.py` and
`nuscenes_api.py`; the answering side in wljungbergh/UniAD, `inference/server.py`.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from foredrive.driving.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.errors import InputError
from foredrive.integrations.remote.sent_tensors import encode_tensors
from foredrive.scene import Clip, Command

NUSCENES_CAMERAS = {
    "PCAM_F0": "CAM_FRONT",
    "PCAM_L0": "CAM_FRONT_LEFT",
    "PCAM_R0": "CAM_FRONT_RIGHT",
    "PCAM_B0": "CAM_BACK",
    "PCAM_L1": "CAM_BACK_LEFT",
    "PCAM_R1": "CAM_BACK_RIGHT",
    "FRONT_CAMERA": "CAM_FRONT",
    "FRONT_LEFT_CAMERA": "CAM_FRONT_LEFT",
    "FRONT_RIGHT_CAMERA": "CAM_FRONT_RIGHT",
    "BACK_CAMERA": "CAM_BACK",
    "LEFT_CAMERA": "CAM_BACK_LEFT",
    "RIGHT_CAMERA": "CAM_BACK_RIGHT",
}
"""nuScenes' names of the cameras of towns (by 123D's names, as py123d converts nuScenes) and of PandaSet, in
capitals. Others keep their names."""
COMMANDS = {Command.RIGHT: 0, Command.LEFT: 1, Command.STRAIGHT: 2}
LIDAR_M = (0.94, 0.0, 1.84)
"""Place of nuScenes' lidar in the ego frame, for vehicles without one."""
GRAVITY_MPS2 = 9.8
MAX_POINTS = 1000


def nuscenes_name(camera: str) -> str:
    """Return the name of a camera that planners for nuScenes know, or its own if there is none."""
    return NUSCENES_CAMERAS.get(camera.upper(), camera)


@dataclass(frozen=True)
class Calibration:
    """Matrices of the sensors, by the names of cameras."""

    camera2image: dict[str, list[list[float]]]
    camera2ego: dict[str, list[list[float]]]
    """From the camera frame (x right, y down, z forward)."""
    lidar2ego: list[list[float]]


@dataclass(frozen=True)
class PlannerInput:
    """One key frame for a planner, as JSON."""

    images: dict[str, str]
    """uint8 [height, width, RGB] tensors as text (`encode_tensors`), by the names of cameras."""
    ego2world: list[list[float]]
    canbus: list[float]
    """Position (3), orientation w x y z, acceleration (3), turn rate (3), velocity (3); see `canbus`."""
    timestamp: int
    """Microseconds."""
    command: int
    """0 right, 1 left, 2 straight."""
    calibration: Calibration
    sweeps: dict[str, str] | None = None
    """Ours: points by the names of lidars, as `lidar_points`. Sent only to planners that shall see lidar."""


@dataclass(frozen=True)
class PlannerOutput:
    """The answer of a planner, as JSON."""

    trajectory: list[list[float]]
    """x forward and y left in the ego frame at now, m; 0.5 s apart, the first 0.5 s ahead."""
    aux_outputs: dict[str, Any] | None = field(default_factory=dict)
    """What the planner has seen. It changes nothing."""


def planner_input(clip: Clip, frame: int, timestamp_us: int, *, cameras: bool, lidar: bool) -> PlannerInput:
    """Return a key frame of an unbatched clip as a message. Its command is that at now."""
    names = list(map(nuscenes_name, clip.rig.names))
    shown = [
        (camera, name) for camera, name in enumerate(names) if cameras and clip.image_valid[frame, camera]
    ]
    rig = clip.rig[frame]
    command = Command(int(clip.command)) if bool(clip.command_valid) else Command.STRAIGHT
    return PlannerInput(
        images={name: encode_tensors(_rows_first(clip.images[frame, camera])) for camera, name in shown},
        ego2world=clip.T_world_ego[frame].tolist(),
        canbus=canbus(clip, frame).tolist(),
        timestamp=timestamp_us,
        command=COMMANDS[command],
        calibration=Calibration(
            {name: rig.K[camera].tolist() for camera, name in shown},
            {name: rig.T_ego_cam[camera].tolist() for camera, name in shown},
            T_ego_lidar(clip, frame).tolist(),
        ),
        sweeps={"LIDAR_TOP": lidar_points(clip, frame)} if lidar and clip.sweep_valid[frame] else None,
    )


def _rows_first(image: Tensor) -> Tensor:
    return image.permute(1, 2, 0).contiguous()


def canbus(clip: Clip, frame: int) -> Float[Tensor, "16"]:
    """Return nuScenes' signals of the vehicle at a key frame, as neuro-ncap emulates them.

    They are position and orientation (yaw alone) in the world, then acceleration (with gravity), turn rate
    and velocity in the ego frame. Acceleration and turn rate are differences to the key frame before.
    """
    T, speed_mps = clip.T_world_ego, clip.ego_speed_mps
    yaw = torch.atan2(T[:, 1, 0], T[:, 0, 0])
    signals = torch.zeros(16)
    signals[:3] = T[frame, :3, 3]
    signals[3], signals[6] = torch.cos(yaw[frame] / 2), torch.sin(yaw[frame] / 2)
    if frame > 0:
        dt_s = float(clip.t_s[frame] - clip.t_s[frame - 1])
        signals[7] = (speed_mps[frame] - speed_mps[frame - 1]) / dt_s
        signals[12] = math.remainder(float(yaw[frame] - yaw[frame - 1]), 2 * math.pi) / dt_s
    signals[9], signals[13] = GRAVITY_MPS2, speed_mps[frame]
    return signals


def T_ego_lidar(clip: Clip, frame: int) -> Float64[Tensor, "4 4"]:
    """Return the frame of nuScenes' lidar (x right, y forward, z up) at the place of the vehicle's lidar.

    Planners for nuScenes predict in this frame, whichever lidar the vehicle has.
    """
    T = torch.eye(4, dtype=torch.float64)
    T[:2, :2] = torch.tensor([[0.0, 1.0], [-1.0, 0.0]])
    sweep = clip.sweeps[frame]
    valid = bool(clip.sweep_valid[frame]) and bool(sweep.valid.any())
    T[:3, 3] = sweep.origin_ego[sweep.valid].median(0).values if valid else torch.tensor(LIDAR_M)
    return T


def lidar_points(clip: Clip, frame: int) -> str:
    """Return the returns of a sweep as text: a dict of xyz (ego frame, m), intensity, time_s and channel."""
    sweep = clip.sweeps[frame]
    hit = sweep.valid & sweep.returned
    return encode_tensors(
        {
            "xyz": sweep.points_ego[hit],
            "intensity": sweep.intensity[hit],
            "time_s": sweep.dt_s[hit],
            "channel": sweep.beam[hit],
        }
    )


def waypoints(output: PlannerOutput) -> Float[Tensor, "T 2"]:
    """Return the points of an answer that count, m: those of 3 s.

    Raises:
        InputError: there are too few or too many, or they are not pairs of finite numbers.
    """
    count = len(output.trajectory)
    if not HORIZON_STEPS <= count <= MAX_POINTS:
        horizon_s = HORIZON_STEPS * FRAME_DT_S
        raise InputError(
            f"the planner answered {count} points; {HORIZON_STEPS} or more are needed, for {horizon_s:g} s"
        )
    points = output.trajectory[:HORIZON_STEPS]
    if any(len(point) != 2 or not all(map(math.isfinite, point)) for point in points):
        raise InputError(f"the planner answered points that are not pairs of finite numbers: {points}")
    return torch.tensor(points)
