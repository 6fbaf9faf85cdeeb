"""`foredrive view`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from foredrive.data import LogPath
    from foredrive.scene import Clip


def view(
    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    save: Path,
    t: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None,
    reach: Annotated[float, tyro.conf.arg(metavar="METRES")] = 50.0,
) -> None:
    """Draw one time of a log: every camera with lidar and boxes, and the scene from above with the map.

    Args:
        log: Folder of a 123D log, or of a split or data root with exactly one log in it.
        save: Picture to write (PNG).
        t: Time since the log's start, s; the middle of the log if not given.
        reach: How far the view from above looks in each direction, m.
    """
    from foredrive.data import find_logs
    from foredrive.errors import InputError
    from foredrive.view.log_sheet import write_log_sheet

    logs = find_logs(log)
    if len(logs) > 1:
        raise InputError(f"{log}: holds {len(logs)} logs; name one, such as {logs[0].folder}")
    clip, t_s = _clip_at(logs[0], t)
    write_log_sheet(save, clip, f"{logs[0].name}    t = {t_s:.2f} s", reach)
    print(f"wrote {save}")


def _clip_at(path: "LogPath", t_s: float | None) -> tuple["Clip", float]:
    """The clip of one frame and its time since the log's start, s."""
    from foredrive.data import ClipConfig, ClipDataset
    from foredrive.data.cameras import pinhole_cameras
    from foredrive.data.logs import Log
    from foredrive.errors import InputError
    from foredrive.scene import VoxelSpec
    from foredrive.view.log_sheet import CAMERA_WIDTH_PX

    log = Log(path)
    duration_s = float(log.t_us[-1] - log.t_us[0]) * 1e-6
    wanted_s = duration_s / 2 if t_s is None else t_s
    if not 0 <= wanted_s <= duration_s:
        raise InputError(f"{path.folder}: no time {wanted_s:g} s in this log of {duration_s:.2f} s")
    camera = next(iter(pinhole_cameras(log).values()), None)
    aspect = 9 / 16 if camera is None else camera.height / camera.width
    config = ClipConfig(
        past_frames=0,
        future_frames=0,
        image_hw=(round(CAMERA_WIDTH_PX * aspect), CAMERA_WIDTH_PX),
        voxels=VoxelSpec((-1.0, -1.0, -1.0), 1.0, (2, 2, 2)),  # labels are not drawn
        now_stride_s=log.period_s or 1.0,
        lidar=True,
        map=True,
    )
    dataset = ClipDataset([path], config, cache_dir=None)
    times_s = [(dataset.now_us(index) - int(log.t_us[0])) * 1e-6 for index in range(len(dataset))]
    nearest = min(range(len(times_s)), key=lambda index: abs(times_s[index] - wanted_s))
    return dataset[nearest].clip, times_s[nearest]
