"""`foredrive score`."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, check_number, check_out_folder
from foredrive.errors import InputError

if TYPE_CHECKING:
    from foredrive.evaluation.detections import DetectionSet, FrameScore

Family = Literal["gaussian", "laplace"]


def score(
    results: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS")],
    truth: Path,
    against: OptionalPath = None,
    out: Path = Path("runs/score"),
    family: Family = "gaussian",
    k: int = 25,
    worst: int = 6,
) -> None:
    """Score detections as a random finite set; write summary.json, report.html and frames.jsonl.

    Args:
        results: nuScenes or COCO results (JSON), or a folder of KITTI's text files; docs/sets.md describes
            how such files state their uncertainty.
        truth: The ground truth in the same format; for COCO its instances.
        against: Other results on the same frames, to compare with.
        out: Folder for summary.json, report.html and frames.jsonl, which has the scores of every frame for
            `foredrive search index --scores`.
        family: Family of the box densities.
        k: Number of best associations to sum if there are too many to sum all.
        worst: Number of frames to draw in the report: those that lost most likelihood.
    """
    for path in (results, truth, *(() if against is None else (against,))):
        if not path.exists():
            raise InputError(f"{path}: No such file or directory")
    check_number("--k", k, low=1)
    check_out_folder(out)
    if worst < 0:
        raise InputError(f"--worst is {worst}: a number of frames is not below 0")

    from rich.console import Console

    from foredrive.evaluation import collect_provenance, peak_rss_gib, write_summary
    from foredrive.evaluation.detections import read_detections, summarise_scores, write_frame_scores
    from foredrive.view.score_report import score_table, write_score_report
    from foredrive.view.table import print_table

    started = time.perf_counter()
    read = read_detections(results, truth, family)
    scores = _scored(read, k, results)
    result = summarise_scores(read, scores)
    figures = result.figures
    if against is not None:
        figures |= _compared(scores, against, truth, family, k)
    figures |= {"family": family, "k": k, "wall_s": time.perf_counter() - started}
    figures |= {"peak_rss_gib": peak_rss_gib(), **collect_provenance()}
    write_summary(out / "summary.json", figures)
    write_frame_scores(out / "frames.jsonl", scores)
    write_score_report(
        out / "report.html", f"{results.name} and the truth, {truth.name}", read, scores, result, worst
    )
    print_table(score_table(figures), Console())
    print(f"wrote {out / 'summary.json'}, {out / 'report.html'} and {out / 'frames.jsonl'}")


def _compared(
    scores: "list[FrameScore]", against: Path, truth: Path, family: Family, k: int
) -> dict[str, Any]:
    """Return the metrics of the other results, and the difference to them."""
    from foredrive.evaluation.detections import compare_scores, read_detections, summarise_scores

    other = read_detections(against, truth, family)
    others = _scored(other, k, against)
    compared, uncompared = compare_scores(scores, others)
    theirs = summarise_scores(other, others).figures
    return {f"against.{key}": value for key, value in theirs.items()} | {
        "against": str(against),
        "against.difference": compared.mean,
        "against.difference_low_95": compared.low,
        "against.difference_high_95": compared.high,
        "against.p_value": compared.p_value,
        "against.frames_not_compared": uncompared,
    }


def _scored(read: "DetectionSet", k: int, path: Path) -> "list[FrameScore]":
    from rich.progress import Progress

    from foredrive.evaluation.detections import score_frames

    with Progress(transient=True) as progress:
        task = progress.add_task(path.name, total=len(read.frames))
        return score_frames(read, k=k, told=lambda done: progress.update(task, completed=done))
