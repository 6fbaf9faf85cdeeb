"""Observations of an agent in simulation: past key frames, combined into a clip."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from torch import Tensor

from foredrive.data.batches import stack_records
from foredrive.data.commands import RouteAhead, clip_route
from foredrive.data.lidar import empty_sweep
from foredrive.driving.dynamics import STEP_S
from foredrive.scene import Boxes, CameraRig, Clip, Command, LidarSweep, Trajectory

FRAME_DT_S = 0.5
FRAME_STEPS = round(FRAME_DT_S / STEP_S)
HORIZON_STEPS = 6


@dataclass(frozen=True)
class KeyFrame:
    """Sensor data and boxes at one time."""

    t_s: float
    T_world_ego: Float64[np.ndarray, "4 4"]
    speed_mps: float
    images: UInt8[Tensor, "C 3 H W"]
    """Without cameras (C = 0) if sensors are off."""
    sweep: LidarSweep | None
    boxes: Boxes
    trusted: bool | None = None
    """As `Rendered.trusted`."""


def make_clip(
    frames: Sequence[KeyFrame],
    rig: CameraRig | None,
    command: Command,
    route: RouteAhead | None = None,
) -> Clip:
    """Build a clip from key frames. The last frame is now; the future is marked invalid.

    Args:
        rig: rig of the images, without leading dimensions. None without images.
        route: next points of the route. None if it is not known.
    """
    count, rig = len(frames), rig or _no_cameras()
    # The observation has as many frames as are given; its future is not known
    route_xy, route_valid = clip_route(route)
    yes = torch.ones(count, dtype=torch.bool)
    sensed = torch.tensor([frame.sweep is not None for frame in frames])
    return Clip(
        t_s=torch.tensor([frame.t_s - frames[-1].t_s for frame in frames]),
        T_world_ego=torch.from_numpy(np.stack([frame.T_world_ego for frame in frames])),
        images=torch.stack([frame.images for frame in frames]),
        image_valid=torch.ones(count, len(rig.names), dtype=torch.bool),
        rig=rig.map_tensors(lambda tensor: tensor.expand(count, *tensor.shape)),
        sweeps=stack_records([frame.sweep or empty_sweep() for frame in frames]),
        sweep_valid=sensed,
        misses_known=sensed,
        boxes=stack_records([frame.boxes for frame in frames]),
        boxes_valid=yes,
        ego_speed_mps=torch.tensor([frame.speed_mps for frame in frames]),
        ego_speed_valid=yes,
        command=torch.tensor(int(command)),
        command_valid=torch.tensor(True),
        route_xy=route_xy,
        route_valid=route_valid,
        future=Trajectory(
            xy=torch.zeros(1, HORIZON_STEPS, 2),
            yaw=torch.zeros(1, HORIZON_STEPS),
            valid=torch.zeros(1, HORIZON_STEPS, dtype=torch.bool),
            log_prob=torch.zeros(1),
            dt_s=FRAME_DT_S,
        ),
    )


def no_images() -> UInt8[Tensor, "0 3 0 0"]:
    """Return the images of a rig without cameras."""
    return torch.zeros(0, 3, 0, 0, dtype=torch.uint8)


def _no_cameras() -> CameraRig:
    return CameraRig(
        K=torch.zeros(0, 3, 3),
        T_ego_cam=torch.zeros(0, 4, 4),
        dist=torch.zeros(0, 5),
        readout_s=torch.zeros(0),
        names=(),
        size_hw=(0, 0),
    )
