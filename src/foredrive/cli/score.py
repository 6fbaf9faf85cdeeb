"""`foredrive score`."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, check_number, check_out_folder
from foredrive.errors import InputError

Family = Literal["gaussian", "laplace"]
Task = Literal["sets", "detection", "tracking", "map", "motion", "occupancy"]


def score(
    results: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS")],
    truth: Path,
    task: Task = "sets",
    poses: OptionalPath = None,
    against: OptionalPath = None,
    out: Path = Path("runs/score"),
    family: Family = "gaussian",
    background_rate: float = 1.0,
    k: int = 25,
    worst: int = 6,
) -> None:
    """Score files of results; write summary.json and report.html.

    Args:
        results: For sets: nuScenes or COCO results (JSON), or a folder of KITTI's text files; docs/sets.md
            describes how such files state their uncertainty. For detection, tracking and motion: nuScenes
            results (JSON), for motion with futures; for detection and tracking also a folder of KITTI's text
            files. For map: JSON of MapTR, or of StreamMapNet's family. For occupancy: a folder of npz files
            as Occ3D or OpenOcc define them.
        truth: The ground truth in the same format; for COCO its instances. For detection and tracking also a
            folder of nuScenes' tables (v1.0-*). For nuScenes' results and all tasks also a folder of 123D
            logs.
        task: sets: detections as a random finite set. The others are scored under all published protocols of
            the task, see docs/tasks.md.
        poses: For occupancy: nuscenes_infos_val.pkl or Occ3D's annotations.json. They give the scored
            frames and the positions of the lidar. Without the file there is no RayIoU.
        against: For sets: other results on the same frames, to compare with.
        out: Folder for summary.json, report.html and, for sets, frames.jsonl, which has the scores of every
            frame for `foredrive search index --scores`.
        family: Family of the box densities.
        background_rate: Expected number of objects a frame that no detection explains, spread evenly over the
            truth's classes and the region. With 0, as in the paper, frames with such an object have an
            infinite NLL and are counted.
        k: Number of best associations to sum if there are too many to sum all.
        worst: Number of frames to draw in the report, beginning with the largest NLL.
    """
    for path in (results, truth, against, poses):
        if path is not None and not path.exists():
            raise InputError(f"{path}: No such file or directory")
    check_out_folder(out)
    if task != "sets":
        if against is not None:
            raise InputError("--against compares sets; it does not go with --task " + task)
        _score_task(task, results, truth, out, poses)
        return
    if poses is not None:
        raise InputError("--poses does not go with --task sets")
    check_number("--background-rate", background_rate, low=0)
    check_number("--k", k, low=1)
    check_number("--worst", worst, low=0)

    from rich.console import Console

    from foredrive.engine.folder import held_for_results
    from foredrive.runs.score.run import FRAMES, SUMMARY, score_detections
    from foredrive.tasks.detection.score import ScoreConfig
    from foredrive.view.score_report import REPORT, score_table, write_score_report
    from foredrive.view.table import print_table

    config = ScoreConfig(background_rate=background_rate, k=k)
    with held_for_results(out):
        scored, figures = score_detections(results, truth, out, against=against, family=family, config=config)
        write_score_report(
            out / REPORT, f"{results.name} and the truth, {truth.name}", scored, figures, worst
        )
    print_table(score_table(figures), Console())
    print(f"wrote {out / SUMMARY}, {out / REPORT} and {out / FRAMES}")


def _score_task(task: Task, results: Path, truth: Path, out: Path, poses: Path | None) -> None:
    from rich.console import Console

    from foredrive.engine.folder import held_for_results
    from foredrive.runs.score.run import SUMMARY
    from foredrive.runs.score.tasks import score_task
    from foredrive.view.score_report import REPORT
    from foredrive.view.table import print_table
    from foredrive.view.task_report import task_tables, write_task_report

    with held_for_results(out):
        figures = score_task(task, results, truth, out, poses)
        write_task_report(out / REPORT, f"{results.name} and the truth, {truth.name}", figures)
    print_table(task_tables(figures)[0], Console())
    print(f"wrote {out / SUMMARY} and {out / REPORT}")
