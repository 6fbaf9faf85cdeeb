"""`foredrive view`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from foredrive.cli.arguments import OptionalPath

if TYPE_CHECKING:
    from foredrive.recipes import Run


def view(
    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    run: OptionalPath = None,
    save: OptionalPath = None,
    t: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None,
    reach: Annotated[float, tyro.conf.arg(metavar="METRES")] = 50.0,
    host: str = "localhost",
    port: int = 8080,
) -> None:
    """Look at a log: in 3-D and over time on a page in the browser, or one time of it as a picture.

    Args:
        log: Folder of a 123D log, or of a split or data root with exactly one log in it.
        run: Folder of a trained run: the page shows what its model sees, imagines and plans, too.
        save: Write a picture (PNG) and serve no page: every camera with lidar and boxes, and the scene from
            above with the map.
        t: Time since the log's start, s; by default the middle of the log.
        reach: How far the picture's view from above looks in each direction, m.
        host: Where the page is served; other machines see it at 0.0.0.0.
        port: The page's port; the next free one if it is taken.
    """
    from foredrive.data import find_logs
    from foredrive.errors import InputError
    from foredrive.view.log_sheet import CAMERA_WIDTH_PX, write_log_sheet
    from foredrive.view.log_times import LogTimes

    logs = find_logs(log)
    if len(logs) > 1:
        raise InputError(f"{log}: holds {len(logs)} logs; name one, such as {logs[0].folder}")
    if save is not None and run is not None:
        raise InputError("--save draws the log alone; leave out --run, or --save for the page")
    times = LogTimes(logs[0], CAMERA_WIDTH_PX, None if run is None else _opened(run))
    index = times.nearest(t)
    if save is not None:
        title = f"{times.name}    t = {times.t_s[index]:.2f} s"
        write_log_sheet(save, times.clip(index), title, reach)
        print(f"wrote {save}")
        return
    from foredrive.view.viewer import Viewer

    viewer = Viewer(times, host, port)
    try:
        viewer.show(index)
        print(f"{times.name} is at {viewer.url} until you press Ctrl-C")
        viewer.play()
    finally:
        viewer.close()


def _opened(run: Path) -> "Run":
    from foredrive.recipes import open_run  # only now: a log alone needs none of it

    return open_run(run)
