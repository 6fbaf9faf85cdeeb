"""`foredrive imagine`."""

from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import check_number, check_run
from foredrive.cli.progress import counted, job_progress
from foredrive.data.log_paths import find_one_log
from foredrive.lazy import importing


def imagine(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    out: Path,
    seconds: float | None = None,
    samples: int = 5,
    moments: int = 4,
) -> None:
    """Write a video of the futures that a trained model imagines, beside the recorded future.

    It shows the scene from above, compared with the lidar, and the camera images if the model renders.

    Args:
        run: Folder of a trained run.
        log: Folder of a 123D log, or of a split or data root with exactly one log in it.
        out: The video: .mp4, or .webp, which browsers play as a picture.
        seconds: Length of each future, s; by default as far as the model imagines and the log goes on, at
            most 4 s.
        samples: Number of futures drawn from a stochastic model; a deterministic model gives one.
        moments: Number of times of the log from which the model imagines.
    """
    from foredrive.view.video import check_video

    check_video(out)
    check_number("--seconds", seconds, above=0)
    check_number("--samples", samples, low=1)
    check_number("--moments", moments, low=1)
    log_path = find_one_log(log)
    run = check_run(run)

    with importing():
        from foredrive.runs import open_run
        from foredrive.runs.evaluate.imagination import imagine_run
        from foredrive.view.imagination_video import write_imagination_video

    opened = open_run(run)
    seen = imagine_run(opened, log_path, seconds=seconds, samples=samples, moments=moments)
    with job_progress("imagining futures", moments) as tick:
        count = write_imagination_video(out, counted(seen, tick), opened.recipe.clips.frame_dt_s)
    print(f"wrote {out}: {count} frames of {opened.recipe.clips.frame_dt_s:g} s")
