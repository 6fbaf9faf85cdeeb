"""Score a file of detections into a folder of results, alone or against another file."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.progress import Progress

from foredrive.engine.provenance import collect_provenance, peak_rss_gib
from foredrive.engine.summary import Figures, write_summary
from foredrive.sets import Family
from foredrive.tasks.detection.files import read_detections, write_frame_scores
from foredrive.tasks.detection.frames import DetectionSet
from foredrive.tasks.detection.score import FrameScore, ScoreConfig, score_frames
from foredrive.tasks.detection.summary import ScoreSummary, compare_scores, summarise_scores

SUMMARY, FRAMES = "summary.json", "frames.jsonl"


@dataclass(frozen=True)
class ScoredDetections:
    """The detections of one file, the scores of their frames, and the figures over all frames."""

    detections: DetectionSet
    frames: list[FrameScore]
    summary: ScoreSummary


def score_detections(
    results: Path,
    truth: Path,
    out: Path,
    *,
    config: ScoreConfig,
    against: Path | None = None,
    family: Family = "gaussian",
) -> tuple[ScoredDetections, Figures]:
    """Score detections; write `out/summary.json` and `out/frames.jsonl`.

    Args:
        results, truth: files or folders of one format, see `read_detections`.
        config: options of the likelihood.
        against: other results on the same frames; their figures and the difference are in the summary too.
        family: family of the box densities.

    Returns:
        The scores, and the written summary.

    Raises:
        InputError: a file cannot be read, or the two results are not on the same frames.
    """
    started = time.perf_counter()
    scored = _score(results, truth, family, config)
    figures = dict(scored.summary.figures)
    if against is not None:
        figures |= _compare(scored, _score(against, truth, family, config), against)
    figures |= {"family": family, **asdict(config), "wall_s": time.perf_counter() - started}
    figures |= {"peak_rss_gib": peak_rss_gib(), **collect_provenance()}
    write_summary(out / SUMMARY, figures)
    write_frame_scores(out / FRAMES, scored.frames)
    return scored, figures


def _score(results: Path, truth: Path, family: Family, config: ScoreConfig) -> ScoredDetections:
    detections = read_detections(results, truth, family)
    with Progress(transient=True) as progress:
        task = progress.add_task(results.name, total=len(detections.frames))
        frames = score_frames(detections, config, on_frame=lambda done: progress.update(task, completed=done))
    return ScoredDetections(detections, frames, summarise_scores(detections, frames))


def _compare(scored: ScoredDetections, other: ScoredDetections, against: Path) -> Figures:
    """Return the figures of the other file, and the difference from it."""
    difference, uncompared = compare_scores(scored.frames, other.frames)
    return {f"against.{key}": value for key, value in other.summary.figures.items()} | {
        "against": str(against),
        "against.difference": difference.mean,
        "against.difference_low_95": difference.low,
        "against.difference_high_95": difference.high,
        "against.p_value": difference.p_value,
        "against.frames_not_compared": uncompared,
    }
