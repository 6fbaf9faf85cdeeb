"""A whole log as one clip: every frame it has, at its own rate."""

from pathlib import Path

import torch

from foredrive.data.boxes import no_boxes, read_boxes
from foredrive.data.cameras import find_camera, pinhole_cameras
from foredrive.data.collate import stack_records
from foredrive.data.image_store import ImageStore
from foredrive.data.lidar import empty_sweep, read_sweep
from foredrive.data.logs import Log, LogPath
from foredrive.data.rigs import read_rig
from foredrive.errors import InputError
from foredrive.scene import Clip


def read_drive(
    path: LogPath,
    image_hw: tuple[int, int],
    cameras: tuple[str, ...] | None = None,
    cache_dir: Path | None = None,
) -> Clip:
    """Read all frames of a log, its sweeps and boxes with them; now is the first, so all times are >= 0.

    Nothing is asked of anyone here: there is no command, no target and no future.

    Args:
        path: the log.
        image_hw: height and width that images are resized to, px.
        cameras: by their own or 123D's names, in this order; None takes all.
        cache_dir: folder for shrunk images; None keeps none.

    Raises:
        InputError: on a log that cannot be read, or that has no camera of a name.
    """
    log = Log(path)
    there = pinhole_cameras(log)
    names = tuple(there) if cameras is None else cameras
    chosen = [find_camera(there, name) for name in names]
    for name, camera in zip(names, chosen, strict=True):
        if camera is None:
            raise InputError(f"{path.folder}: no camera {name!r}; there are: {', '.join(there) or 'none'}")
    frames = list(range(len(log)))
    images, image_valid, rig = read_rig(log, frames, chosen, names, ImageStore(cache_dir, image_hw), frames)
    sweeps = [read_sweep(log, frame) for frame in frames]
    boxes = [read_boxes(log, frame) for frame in frames]
    speed_mps = torch.from_numpy(log.speed_mps).float()
    return Clip(
        t_s=torch.from_numpy((log.t_us - log.t_us[0]) * 1e-6).float(),
        T_world_ego=torch.from_numpy(log.T_world_ego),
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
        command=torch.tensor(0),
        command_valid=torch.tensor(False),
        target_xy=torch.zeros(2),
        target_valid=torch.tensor(False),
        future=log.driven_future(0, 0, log.period_s),
    )
