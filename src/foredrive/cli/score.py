"""`foredrive score`."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, check_number, check_out_folder
from foredrive.errors import InputError

Family = Literal["gaussian", "laplace"]


def score(
    results: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS")],
    truth: Path,
    against: OptionalPath = None,
    out: Path = Path("runs/score"),
    family: Family = "gaussian",
    background_rate: float = 1.0,
    k: int = 25,
    worst: int = 6,
) -> None:
    """Score detections as a random finite set; write summary.json, report.html and frames.jsonl.

    Args:
        results: nuScenes or COCO results (JSON), or a folder of KITTI's text files. docs/sets.md describes
            how such files state their uncertainty.
        truth: The ground truth in the same format; for COCO its instances.
        against: Other results on the same frames, to compare with.
        out: Folder for summary.json, report.html and frames.jsonl, which has the scores of every frame for
            `foredrive search index --scores`.
        family: Family of the box densities.
        background_rate: Expected number of objects a frame that no detection explains, spread evenly over the
            truth's classes and the region. With 0, as in the paper, frames with such an object have an
            infinite NLL and are counted.
        k: Number of best associations to sum if there are too many to sum all.
        worst: Number of frames to draw in the report, beginning with the largest NLL.
    """
    for path in (results, truth, *(() if against is None else (against,))):
        if not path.exists():
            raise InputError(f"{path}: No such file or directory")
    check_number("--background-rate", background_rate, low=0)
    check_number("--k", k, low=1)
    check_out_folder(out)
    check_number("--worst", worst, low=0)

    from rich.console import Console

    from foredrive.evaluation.detections.score import ScoreConfig
    from foredrive.runs.score.run import FRAMES, SUMMARY, score_detections
    from foredrive.view.score_report import REPORT, score_table, write_score_report
    from foredrive.view.table import print_table

    config = ScoreConfig(background_rate=background_rate, k=k)
    scored, figures = score_detections(results, truth, out, against=against, family=family, config=config)
    write_score_report(out / REPORT, f"{results.name} and the truth, {truth.name}", scored, figures, worst)
    print_table(score_table(figures), Console())
    print(f"wrote {out / SUMMARY}, {out / REPORT} and {out / FRAMES}")
