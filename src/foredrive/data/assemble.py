"""Assembly of a clip from the data of a log's frames."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8
from torch import Tensor

from foredrive.data.batches import stack_records
from foredrive.data.boxes import no_boxes, read_boxes
from foredrive.data.lidar import empty_sweep
from foredrive.data.logs import Log
from foredrive.scene import CameraRig, Clip, LidarSweep, MapPatch, Trajectory


def assemble_clip(
    log: Log,
    frames: Sequence[int],
    now: int,
    seen: tuple[UInt8[Tensor, "T C 3 H W"], Bool[Tensor, "T C"], CameraRig],
    sweeps: Sequence[tuple[LidarSweep, bool] | None],
    future: Trajectory,
    *,
    command: int | None = None,
    target_xy: Float64[np.ndarray, "2"] | None = None,
    map_patch: MapPatch | None = None,
) -> Clip:
    """Assemble a clip of T frames with their boxes, poses and speeds. Arguments that are None are masked.

    Args:
        log: the source log.
        frames: T frames of the log.
        now: the frame at t = 0.
        seen: images, their validity and the rig, see `read_rig`.
        sweeps: T sweeps, each with whether it includes the beams that did not return.
        future: path of the vehicle from now on.
        command: driving command at now.
        target_xy: target point of the route in the ego frame at now, m.
        map_patch: map around the vehicle at now.

    Raises:
        InputError: the boxes cannot be read.
    """
    chosen = list(frames)
    boxes = [read_boxes(log, frame) for frame in chosen]
    speed_mps = torch.from_numpy(log.speed_mps[chosen]).float()
    images, image_valid, rig = seen
    return Clip(
        t_s=torch.from_numpy((log.t_us[chosen] - log.t_us[now]) * 1e-6).float(),
        T_world_ego=torch.from_numpy(log.T_world_ego[chosen]),
        images=images,
        image_valid=image_valid,
        rig=rig,
        sweeps=stack_records([empty_sweep() if sweep is None else sweep[0] for sweep in sweeps]),
        sweep_valid=torch.tensor([sweep is not None for sweep in sweeps]),
        misses_known=torch.tensor([sweep is not None and sweep[1] for sweep in sweeps]),
        boxes=stack_records([no_boxes() if b is None else b for b in boxes]),
        boxes_valid=torch.tensor([b is not None for b in boxes]),
        ego_speed_mps=speed_mps.nan_to_num(),
        ego_speed_valid=speed_mps.isfinite(),
        command=torch.tensor(0 if command is None else int(command)),
        command_valid=torch.tensor(command is not None),
        target_xy=torch.zeros(2) if target_xy is None else torch.from_numpy(target_xy).float(),
        target_valid=torch.tensor(target_xy is not None),
        future=future,
        map=map_patch,
    )
