"""`foredrive view`."""

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from foredrive.cli.arguments import RUN_CONFIG, OptionalPath, check_file, check_number, check_run
from foredrive.data.log_paths import find_one_log
from foredrive.errors import InputError
from foredrive.lazy import importing

if TYPE_CHECKING:
    from foredrive.runs import Run
    from foredrive.view.log_frames import LogFrames

EDITS = "edits.json"
OPENED = (
    "view opens the folder of a 123D log, of a split or data root with one log in it, "
    "or of a reconstruction, and lists of clips (.json) of one log; `foredrive convert` makes logs"
)


def view(
    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    run: OptionalPath = None,
    edits: OptionalPath = None,
    save: OptionalPath = None,
    t: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None,
    reach: Annotated[float, tyro.conf.arg(metavar="METRES")] = 50.0,
    host: str = "localhost",
    port: int = 8080,
) -> None:
    """Show a log or a reconstruction in 3-D and over time, on a page in the browser.

    With --save one time of a log is written as a picture instead. In a reconstruction, actors can be dragged,
    removed and added.

    Args:
        log: Folder of a 123D log, or of a split or data root with exactly one log in it; or the folder of a
            reconstruction.
        run: Folder of a trained run: the page also shows what its model predicts, imagines and plans.
        edits: For a reconstruction: file of edits that the page loads and saves. By default the page starts
            without edits and saves them as "edits.json" in the folder of the reconstruction.
        save: Write a picture (PNG) and serve no page: every camera with lidar and boxes, and the scene from
            above with the map. With --run: the images, the occupancy that the model predicts, and its plan.
        t: Time since the start of the log, s; by default the middle of a log, or near it where more of its
            sensors have data; the start of a reconstruction.
        reach: Distance that the picture's view from above shows in each direction, m.
        host: Address at which the page is served; use 0.0.0.0 to make it visible to other machines.
        port: The page's port; if it is taken, the next free port.
    """
    check_number("--t", t)
    check_number("--reach", reach, above=0)
    check_number("--port", port, low=1, high=65535)
    check_file(edits)
    if (log / RUN_CONFIG).is_file():
        if run is not None or save is not None:
            raise InputError(
                f"{log}: --run and --save need a log; `foredrive render` makes videos of reconstructions"
            )
        _serve_reconstructed(log, edits, t, host, port)
        return
    if edits is not None:
        raise InputError(f"{log}: --edits needs the folder of a reconstruction")
    if log.is_file() and log.suffix != ".json":
        raise InputError(f"{log}: {OPENED}")
    log_path = find_one_log(log)
    if run is not None:
        run = check_run(run)

    with importing():
        from foredrive.view.log_frames import CAMERA_WIDTH_PX, LogFrames

    frames = LogFrames(log_path, CAMERA_WIDTH_PX, None if run is None else _opened(run))
    index = frames.nearest(t)
    if save is not None:
        _save(save, frames, index, reach)
        return
    from foredrive.view.viewer import Viewer

    with closing(Viewer(frames, host, port)) as viewer:
        viewer.show(index)
        print(f"{frames.name} is at {viewer.url} until you press Ctrl-C", flush=True)
        viewer.play()


def _save(path: Path, frames: "LogFrames", index: int, reach_m: float) -> None:
    """Write the picture of one time: of the log, or of what a run's model sees and plans."""
    title = f"{frames.name}    t = {frames.t_s[index]:.2f} s"
    if frames.run is None:
        from foredrive.view.log_sheet import write_log_sheet

        write_log_sheet(path, frames.clip(index), title, reach_m)
    else:
        from foredrive.view.overview import Overview, write_overview

        prediction = frames.prediction(index)
        if prediction is None:
            raise InputError(f"{title}: too few frames before this one for the model; choose a later --t")
        spec = frames.run.recipe.clips.voxels
        occupied = prediction.occupancy_logit[0] > 0
        write_overview(path, Overview(title, frames.clip(index), occupied, prediction.plan, spec))
    print(f"wrote {path}")


def _opened(run: Path) -> "Run":
    from foredrive.runs import open_run  # Imported only here, because logs alone do not need it

    return open_run(run)


def _serve_reconstructed(folder: Path, edits: Path | None, t_s: float | None, host: str, port: int) -> None:
    with importing():
        from foredrive.methods.reconstruction.edits import load_edits
        from foredrive.runs.reconstruction.reconstruction_run import edited_scene, open_reconstruction
        from foredrive.view.reconstruction_viewer import ReconstructedViewer

    run = open_reconstruction(folder)
    if t_s is not None:
        run.vehicle.check_time(t_s)
    edit_list = [] if edits is None else load_edits(edits)
    # Report edits that do not fit the scene before the page is served
    edited_scene(run.scene, edit_list)
    with closing(ReconstructedViewer(run, edit_list, edits or folder / EDITS, host, port)) as viewer:
        if t_s is not None:
            viewer.show(t_s)
        print(f"{folder.name} is at {viewer.url} until you press Ctrl-C", flush=True)
        viewer.play()
