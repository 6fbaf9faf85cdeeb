"""`foredrive export`: of a trained run, and of logs to other formats."""

import importlib.util
import os
from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import (
    OptionalPath,
    SomePaths,
    check_number,
    check_out_folder,
    check_run,
    whole_logs,
)
from foredrive.cli.failures import listed_failures
from foredrive.cli.progress import frame_progress, progress_lines
from foredrive.data.log_paths import find_all_logs
from foredrive.errors import InputError
from foredrive.lazy import importing


def export(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    out: OptionalPath = None,
    logs: SomePaths = (),
    clips: int = 8,
) -> None:
    """Write a trained run as model.onnx and model.pt2 (torch.export); compare both with the run itself.

    Args:
        run: Folder of a trained run.
        out: Folder for the models and export.json, which describes inputs, outputs, differences and
            latencies; by default "export" in the run's folder.
        logs: 123D logs, splits or data roots for the comparison; by default the training logs.
        clips: Number of clips to compare.
    """
    run = check_run(run)
    check_number("--clips", clips, low=1)
    check_out_folder(out)
    named = find_all_logs(logs)

    with importing():
        from foredrive.engine.folder import held_for_results
        from foredrive.runs import open_run
        from foredrive.runs.export import export_run

    trained = open_run(run)
    folder = out or run / "export"
    with held_for_results(folder):
        facts = export_run(trained, named or trained.logs, folder, clips)
    for name, latency in facts["latency_ms"].items():
        print(f"{name}: {latency['median']:.1f} ms a clip (90 % below {latency['p90']:.1f} ms)")
        for output, difference in facts["largest_difference"].get(name, {}).items():
            print(f"    {output}: maximum difference {difference:.2g}")
    print(f"wrote {folder / 'model.onnx'}, {folder / 'model.pt2'} and {folder / 'export.json'}")


def export_mcap(
    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    out: Path,
    run: OptionalPath = None,
) -> None:
    """Write a log as an MCAP file of Foxglove's schemas, with a run's plans if one is named.

    The file has images, calibrations, sweeps, boxes, the map, poses and the driven path; with a run also the
    plan and the predicted occupancy. The schemas are Foxglove's; for Rerun see `export rerun`.

    Args:
        log: A log, or a data root with one log.
        out: The file, which ends in .mcap.
        run: Folder of a trained run whose predictions are added.
    """
    from foredrive.data.log_paths import find_one_log

    for package in ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf"):
        if importlib.util.find_spec(package) is None:
            raise InputError(f"MCAP files need the package {package}: pip install 'foredrive[bags]'")
    path = find_one_log(log)
    if run is not None:
        run = check_run(run)

    with importing():
        from foredrive.runs import open_run
        from foredrive.view.log_mcap import write_log_mcap

    with progress_lines(lambda: f"exporting {path.name}"):
        topics = write_log_mcap(path, out, None if run is None else open_run(run))
    print(f"wrote {out} with {', '.join(topics)}")


def export_ncore(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")],
    out: Path,
    overwrite: bool = False,
) -> None:
    """Write logs as sequences in NVIDIA's NCore v4 format, the format of NuRec, 3DGRUT and AlpaSim's scenes.

    A sequence has the images, calibrations, sweeps with their misses, poses and boxes of a log. Exported logs
    are kept, so an interrupted export continues where it stopped. A log that cannot be read does not stop the
    others.

    Args:
        logs: Logs, splits or data roots.
        out: Folder; a log becomes OUT/SPLIT/NAME/NAME.json and the stores beside it.
        overwrite: Export logs again that were exported before.
    """
    if importlib.util.find_spec("ncore") is None:
        raise InputError("NCore needs the package nvidia-ncore: pip install 'foredrive[ncore]'")
    check_out_folder(out)
    log_paths = whole_logs("export ncore", logs)

    with importing():
        from foredrive.data.logs import Log
        from foredrive.files import atomic_path
        from foredrive.integrations.ncore import write_ncore

    failed: dict[str, str] = {}
    with frame_progress("exporting") as tick:
        for path in log_paths:
            folder = out / path.name
            if folder.is_dir() and not overwrite:
                print(f"kept {folder} (was there; --overwrite exports it again)", flush=True)
                continue
            try:
                with atomic_path(folder) as temporary:
                    temporary.mkdir()
                    write_ncore(Log(path), temporary, tick)
            except InputError as error:
                failed[path.name] = str(error)
            else:
                print(f"wrote {folder}", flush=True)
    if failed and len(log_paths) == 1:
        raise InputError(next(iter(failed.values())))
    if failed:
        raise InputError(f"{len(failed)} of {len(log_paths)} logs failed: {listed_failures(failed)}")


def export_nuscenes(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")],
    out: Path,
    name: str = "foredrive",
    rate: float = 2.0,
    sweeps: bool = True,
    workers: int = 0,
    overwrite: bool = False,
) -> None:
    """Write logs as a data set in nuScenes' format v1.0, which nuscenes-devkit opens.

    OUT gets v1.0-NAME with all tables, samples, sweeps and maps. Exported logs are kept, so an interrupted
    export continues where it stopped, and more logs can be added. A log that cannot be read does not stop the
    others.

    Args:
        logs: Logs, splits or data roots.
        out: Root of the data set: the devkit's dataroot.
        name: The tables are in v1.0-NAME: the devkit's version.
        rate: Samples (key frames) a second. The frames between them are sweeps.
        sweeps: Write the frames between the samples too.
        workers: Number of logs exported at a time; 0: one for each core.
        overwrite: Export logs again that were exported before.
    """
    check_number("--rate", rate, above=0)
    check_number("--workers", workers, low=0)
    check_out_folder(out)
    log_paths = whole_logs("export nuscenes", logs)

    with importing():
        from foredrive.integrations.nuscenes.dataset import NuScenesFolder
        from foredrive.integrations.nuscenes.scene import SceneOptions
        from foredrive.runs.nuscenes import export_nuscenes

    folder, failed = NuScenesFolder(out, name, SceneOptions(rate, sweeps)), {}
    with frame_progress("exporting") as tick:
        cores = workers or len(os.sched_getaffinity(0))
        for done in export_nuscenes(log_paths, folder, cores, overwrite=overwrite, tick=tick):
            if done.failure is not None:
                failed[done.name] = done.failure
            elif done.kept:
                print(f"kept {done.name} (was there; --overwrite exports it again)", flush=True)
            else:
                print(f"exported {done.name}", flush=True)
    print(f"wrote {folder.tables}")
    if failed:
        raise InputError(f"{len(failed)} of {len(log_paths)} logs failed: {listed_failures(failed)}")


def export_rerun(
    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    out: Path,
    run: OptionalPath = None,
    reconstructed: Annotated[OptionalPath, tyro.conf.arg(name="in", metavar="RECONSTRUCTED")] = None,
) -> None:
    """Write a log as a file of Rerun, with a run's plans and a reconstruction's Gaussians if they are named.

    The file has images, sweeps, boxes, the map, poses and the driven path, and a blueprint; with a run also
    the plan and the predicted occupancy. Open it with `rerun FILE`. Rerun's cameras are pinholes: images are
    not undistorted.

    Args:
        log: A log, or a data root with one log.
        out: The file, which ends in .rrd.
        run: Folder of a trained run whose predictions are added.
        reconstructed: Folder of a reconstruction of this log whose Gaussians are added.
    """
    from foredrive.data.log_paths import find_one_log

    if importlib.util.find_spec("rerun") is None:
        raise InputError("Rerun's files need the package rerun-sdk: pip install 'foredrive[rerun]'")
    path = find_one_log(log)
    if run is not None:
        run = check_run(run)

    os.environ.setdefault("RUST_LOG", "off")  # Rerun's own lines about a full disk
    with importing():
        from foredrive.runs import open_run
        from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
        from foredrive.view.log_rerun import write_log_rerun

    rebuilt = None if reconstructed is None else open_reconstruction(reconstructed)
    with progress_lines(lambda: f"exporting {path.name}"):
        entities = write_log_rerun(path, out, None if run is None else open_run(run), rebuilt)
    print(f"wrote {out} with {', '.join(entities)}")
