"""The report on a file of detections: metrics, reliability, and the frames with the largest NLL."""

from pathlib import Path

from foredrive.evaluation.detections.score import PARTS, FrameScore
from foredrive.evaluation.summary import Summary
from foredrive.runs.score.run import ScoredDetections
from foredrive.view.detection_frame_plot import draw_detection_frame
from foredrive.view.html import inline_svg, write_page
from foredrive.view.reliability_diagram import draw_reliability
from foredrive.view.summary_tables import full_table
from foredrive.view.table import Column, Table, number, simple_table, words

REPORT = "report.html"
SHOWN = {
    "frames": "Frames",
    "objects": "Objects",
    "detections": "Detections",
    "pmb_nll.mean": "PMB-NLL, nats a frame",
    **{f"pmb_nll.{part}": f"  {part.replace('_', ' ')}" for part in PARTS},
    "pmb_nll.gap": "  maximum error of the approximation",
    "pmb_nll.frames_infinite": "Frames with infinite NLL",
    "map": "mAP",
    "gospa.distance": "GOSPA",
    "pgospa.distance": "P-GOSPA",
    "calibration.d_ece": "D-ECE",
    "calibration.existence": "Calibration error of existence",
    "calibration.object_level": "Object-level calibration error",
    "std.best_factor": "Best-fitting factor on standard deviations",
    "conformal.coverage_90": "Coverage of conformal 90 % boxes",
}
COMPARED = {
    "against.difference": "Difference of PMB-NLL, nats a frame",
    "against.difference_low_95": "  95 % interval, from",
    "against.difference_high_95": "  to",
    "against.p_value": "  p-value",
    "against.frames_not_compared": "Frames not compared, as one NLL is infinite",
}


def score_table(figures: Summary) -> Table:
    """Return a table of the main metrics, with those of the other file beside them if there is one."""
    other = figures.get("against")
    prefixes = ("",) if other is None else ("", "against.")
    names = ("",) if other is None else ("results", Path(str(other)).name)
    rows = [
        (title, *(figures.get(prefix + key) for prefix in prefixes))
        for key, title in SHOWN.items()
        if figures.get(key) is not None
    ]
    rows += [(title, figures[key], "") for key, title in COMPARED.items() if key in figures]
    columns = [Column(align="left"), *(Column(name) for name in names)]
    return simple_table(columns, rows, "Detections as a random finite set")


def write_score_report(
    path: Path, title: str, scored: ScoredDetections, figures: Summary, worst: int
) -> None:
    """Write the page about a file of detections.

    Args:
        figures: the summary, with the figures of the other file if there is one.
        worst: number of frames to draw, beginning with the largest NLL.
    """
    ranked = sorted(zip(scored.detections.frames, scored.frames, strict=True), key=lambda pair: -pair[1].nll)
    write_page(
        path,
        "score_report.html.j2",
        title=title,
        table=score_table(figures),
        diagrams=[inline_svg(draw_reliability(*each)) for each in scored.summary.diagrams.items()],
        frames=[
            (inline_svg(draw_detection_frame(frame, score, scored.detections.is_3d)), _caption(score))
            for frame, score in ranked[:worst]
        ],
        all_metrics=full_table(figures),
    )


def _caption(score: FrameScore) -> str:
    parts = ", ".join(f"{words(part)} {number(score.parts[part], 1)}" for part in PARTS)
    return f"{score.name}: {number(score.nll, 1)} nats ({parts})"
