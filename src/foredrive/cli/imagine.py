"""`foredrive imagine`."""

from pathlib import Path
from typing import Annotated

import tyro


def imagine(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    out: Path,
    seconds: float = 4.0,
    samples: int = 5,
    moments: int = 4,
) -> None:
    """Film the futures that a trained model imagines, beside what happened.

    From above, against what lidar saw then, and through the cameras where the model renders.

    Args:
        run: Folder of a trained run.
        log: Folder of a 123D log, or of a split or data root with exactly one log in it.
        out: The video: .mp4, or .webp, which browsers play as a picture.
        seconds: How far is imagined.
        samples: How many futures are drawn from a model that knows chance; one that does not has one.
        moments: From how many times of the log.
    """
    from foredrive.data import find_logs
    from foredrive.errors import InputError
    from foredrive.runs import open_run
    from foredrive.runs.evaluate.imagination import imagine_run
    from foredrive.view.imagination_video import write_imagination_video
    from foredrive.view.video import check_video

    check_video(out)
    logs = find_logs(log)
    if len(logs) > 1:
        raise InputError(f"{log}: holds {len(logs)} logs; name one, such as {logs[0].folder}")
    opened = open_run(run)
    seen = imagine_run(opened, logs[0], seconds=seconds, samples=samples, moments=moments)
    count = write_imagination_video(out, seen, opened.recipe.clips.frame_dt_s)
    print(f"wrote {out}: {count} frames of {opened.recipe.clips.frame_dt_s:g} s")
