"""The report on a file of detections: figures, reliability, and the frames where most likelihood was lost."""

from collections.abc import Mapping, Sequence
from html import escape, unescape
from pathlib import Path

from rich.console import Console
from rich.table import Table

from foredrive.evaluation.detections import DetectionSet, FrameScore, ScoreSummary
from foredrive.evaluation.detections.score import PARTS
from foredrive.files import atomic_path
from foredrive.view.frame_of_detections import draw_frame
from foredrive.view.inline_svg import inline_svg
from foredrive.view.reliability_diagram import draw_reliability
from foredrive.view.report_style import CSS
from foredrive.view.summary_tables import full_table, number

Figures = Mapping[str, float | int | str | None]
SHOWN = {
    "frames": "Frames",
    "objects": "Objects",
    "detections": "Detections",
    "pmb_nll.mean": "PMB-NLL, nats a frame",
    **{f"pmb_nll.{part}": f"  {part.replace('_', ' ')}" for part in PARTS},
    "pmb_nll.gap": "  too large by no more than",
    "pmb_nll.frames_infinite": "Frames of infinite NLL",
    "map": "mAP",
    "gospa.distance": "GOSPA",
    "pgospa.distance": "P-GOSPA",
    "calibration.d_ece": "D-ECE",
    "calibration.existence": "Calibration of existence, by associations",
    "calibration.object_level": "Object-level calibration error",
    "std.best_factor": "Factor on standard deviations that fits best",
    "conformal.coverage_90": "Coverage of conformal 90 % boxes",
}
COMPARED = {
    "against.difference": "PMB-NLL less that of the other file, nats a frame",
    "against.difference_low_95": "  95 % interval, from",
    "against.difference_high_95": "  to",
    "against.p_value": "  p-value",
    "against.frames_not_compared": "Frames in which either is infinite, not compared",
}


def print_scores(figures: Figures, console: Console) -> None:
    """The figures a reader looks for first."""
    other = figures.get("against")
    table = Table(title="Detections as a random finite set", show_header=other is not None)
    table.add_column(no_wrap=True)
    for name in ("these",) if other is None else ("these", Path(str(other)).name):
        table.add_column(name, justify="right")
    for title, values in _rows(figures):
        table.add_row(title, *(unescape(value) for value in values))
    console.print(table)


def write_score_report(
    path: Path, title: str, read: DetectionSet, scores: Sequence[FrameScore], result: ScoreSummary, worst: int
) -> None:
    """Write the page: one HTML file with its pictures inside, which loads nothing from anywhere."""
    ranked = sorted(range(len(scores)), key=lambda n: -scores[n].nll)[:worst]
    diagrams = [
        f"<figure>{inline_svg(draw_reliability(name, diagram))}</figure>"
        for name, diagram in result.diagrams.items()
    ]
    pictures = [
        f"<figure>{inline_svg(draw_frame(read.frames[n], scores[n], read.upright))}"
        f"<figcaption>{escape(_caption(scores[n]))}</figcaption></figure>"
        for n in ranked
    ]
    parts = [
        f"<h1>{escape(title)}</h1>",
        _table(result.figures),
        "<h2>Reliability</h2>",
        f"<div class='grid two'>{''.join(diagrams)}</div>",
        "<h2>Where likelihood was lost</h2>",
        "<p class='note'>Frames ranked by their PMB-NLL. Objects are green, and joined to their likeliest "
        "detection; red ones have none. Detections are blue, as strong as they exist, with ellipses of two "
        "standard deviations of the centre.</p>",
        f"<div class='grid two'>{''.join(pictures)}</div>",
        f"<details><summary>Every figure</summary>{full_table(result.figures)}</details>",
    ]
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f"<title>{escape(title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )
    with atomic_path(path) as scratch:
        scratch.write_text(page, encoding="utf-8")


def _rows(figures: Figures) -> list[tuple[str, list[str]]]:
    """Titles with figures, and beside them those of the other file if there is one."""
    prefixes = ("",) if figures.get("against") is None else ("", "against.")
    rows = [
        (title, [number(figures.get(prefix + key)) for prefix in prefixes])
        for key, title in SHOWN.items()
        if figures.get(key) is not None
    ]
    return rows + [(title, [number(figures[key]), ""]) for key, title in COMPARED.items() if key in figures]


def _table(figures: Figures) -> str:
    other = figures.get("against")
    head = f"<tr><th></th><th>these</th><th>{escape(Path(str(other)).name)}</th></tr>" if other else ""
    rows = "".join(
        f"<tr><th scope='row'>{_indented(title)}</th>"
        + "".join(f"<td>{value}</td>" for value in values)
        + "</tr>"
        for title, values in _rows(figures)
    )
    return f"<table>{head}{rows}</table>"


def _indented(name: str) -> str:
    return ("&emsp;" if name.startswith(" ") else "") + escape(name.strip())


def _caption(score: FrameScore) -> str:
    parts = ", ".join(f"{part.replace('_', ' ')} {number(score.parts[part], 1)}" for part in PARTS)
    return f"{score.name}: {number(score.nll, 1)} nats ({parts})"
