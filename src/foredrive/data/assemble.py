"""Assembly of a clip from the data of a log's frames."""

from collections.abc import Sequence

import torch

from foredrive.data.batches import stack_records
from foredrive.data.commands import RouteAhead, clip_route
from foredrive.data.frame_store import FrameData
from foredrive.data.lidar import empty_sweep
from foredrive.data.logs import Log
from foredrive.scene import Clip, LidarSweep, MapPatch, Trajectory


def assemble_clip(
    log: Log,
    frames: Sequence[int],
    now: int,
    seen: Sequence[FrameData],
    sweeps: Sequence[tuple[LidarSweep, bool] | None],
    future: Trajectory,
    *,
    command: int | None = None,
    route: RouteAhead | None = None,
    map_patch: MapPatch | None = None,
) -> Clip:
    """Assemble a clip of T frames with their poses and speeds. Arguments that are None are masked.

    Args:
        log: the source log.
        frames: T frames of the log.
        now: the frame at t = 0.
        seen: cameras and boxes of the T frames.
        sweeps: T sweeps, each with whether it includes the beams that did not return.
        future: path of the vehicle from now on.
        command: driving command at now.
        route: the next points of the route.
        map_patch: map around the vehicle at now.
    """
    chosen = list(frames)
    # Unknown speeds are NaN in a log; in a clip they are masked zeros
    speed_mps = torch.from_numpy(log.speed_mps[chosen]).float()
    whole = stack_records(seen)
    route_xy, route_valid = clip_route(route)
    return Clip(
        t_s=torch.from_numpy((log.t_us[chosen] - log.t_us[now]) * 1e-6).float(),
        T_world_ego=torch.from_numpy(log.T_world_ego[chosen]),
        images=whole.images,
        image_valid=whole.image_valid,
        rig=whole.rig,
        sweeps=stack_records([empty_sweep() if sweep is None else sweep[0] for sweep in sweeps]),
        sweep_valid=torch.tensor([sweep is not None for sweep in sweeps]),
        misses_known=torch.tensor([sweep is not None and sweep[1] for sweep in sweeps]),
        boxes=whole.boxes,
        boxes_valid=whole.boxes_valid,
        ego_speed_mps=speed_mps.nan_to_num(),
        ego_speed_valid=speed_mps.isfinite(),
        command=torch.tensor(0 if command is None else int(command)),
        command_valid=torch.tensor(command is not None),
        route_xy=route_xy,
        route_valid=route_valid,
        future=future,
        map=map_patch,
    )
