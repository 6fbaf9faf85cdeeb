"""`foredrive render`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, check_file, check_number, check_reconstruction
from foredrive.lazy import importing

MAX_SHIFT_M = 100.0


def render(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    out: Path,
    shift_left: Annotated[float, tyro.conf.arg(metavar="METRES")] = 0.0,
    remove: Annotated[tuple[int, ...], tyro.conf.arg(metavar="ACTOR [ACTOR ...]")] = (),
    insert: Annotated[tuple[str, ...], tyro.conf.arg(metavar="RUN:ACTOR@WAY [RUN:ACTOR@WAY ...]")] = (),
    edits: OptionalPath = None,
    save_edits: OptionalPath = None,
    cameras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CAMERA [CAMERA ...]")] = (),
    lidar: Literal["pandar64", "hdl32e", "vlp16"] | None = None,
    colour: Literal["intensity", "height"] = "intensity",
    start: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 0.0,
    seconds: float | None = None,
    rate_hz: float | None = None,
    dim_unseen: bool = False,
) -> None:
    """Write a video of a reconstructed log: its cameras, and its lidar from above.

    If there are edits, the edited scene is shown beside the unedited one. The log itself is not needed.
    Numbers in the view from above are the actors' ids.

    Args:
        run: Folder of a reconstruction.
        out: The video: .mp4, or .webp, which browsers play as a picture.
        shift_left: Shift the ego vehicle's path to the left by this distance, m; negative: to the right.
        remove: Ids of actors to remove.
        insert: Actors of other runs, each on the path of an actor of this run; remove that actor with
            --remove.
        edits: File of edits, applied before those of the other flags.
        save_edits: Write all edits to this file, so that --edits can apply them again.
        cameras: Show only these cameras, in this order, by their own names or 123D's, such as pcam_f0; by
            default all reconstructed cameras.
        lidar: Mount this lidar in place of the log's lidar; by default the log's own, if its beam pattern is
            known.
        colour: Quantity that colours the lidar's points.
        start: Start of the video, s since the start of the log.
        seconds: Length of the video, s; by default until the end of the log.
        rate_hz: Frames per second, shown in real time; by default the rate of the log.
        dim_unseen: Darken surfaces that no image of the training shows.
    """
    from foredrive.view.video import check_video

    check_video(out)
    check_number("--shift-left", shift_left, low=-MAX_SHIFT_M, high=MAX_SHIFT_M)
    check_number("--start", start)
    check_number("--seconds", seconds, above=0)
    check_number("--rate-hz", rate_hz, above=0)
    check_file(edits)
    check_reconstruction(run)

    with importing():
        from foredrive.methods.reconstruction.edits import load_edits
        from foredrive.methods.reconstruction.edits import save_edits as write_edits
        from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
        from foredrive.runs.reconstruction.render import edits_from_arguments, plan_frames
        from foredrive.runs.reconstruction.trust import trained_views
        from foredrive.view.reconstruction_video import write_reconstruction_video

    opened = open_reconstruction(run)
    plan = plan_frames(opened.vehicle, cameras, lidar, start_s=start, seconds=seconds, rate_hz=rate_hz)
    if dim_unseen:
        plan = dataclasses.replace(plan, observed=trained_views(opened))
    edit_list = [] if edits is None else load_edits(edits)
    tracks = opened.scene.graph.all_tracks
    changes = [*edit_list, *edits_from_arguments(tracks, edit_list, shift_left, remove, insert)]
    write_reconstruction_video(out, opened, changes, plan, colour)
    if save_edits is not None:
        write_edits(changes, save_edits)
    print(f"wrote {out}: {len(plan.t_s)} frames")
