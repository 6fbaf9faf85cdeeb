"""The report on a file of detections: metrics, reliability, and the frames with the largest NLL."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon
from numpy import ndarray

from foredrive.engine.summary import Summary
from foredrive.runs.score.run import ScoredDetections
from foredrive.tasks.detection.frames import DetectionFrame
from foredrive.tasks.detection.reliability import Reliability
from foredrive.tasks.detection.score import PARTS, FrameScore
from foredrive.view.html import INK_MARK, inline_svg, style_axes, write_page
from foredrive.view.summary_tables import full_table
from foredrive.view.table import Column, Table, number, simple_table, words

OBJECT, MISSED, DETECTION = "#2eb67d", "#e5484d", "#3f8efc"
MIN_EXISTENCE = 0.02
"""Minimum probability of existence of a drawn detection."""
MAX_DRAWN = 1000
"""Maximum number of drawn detections; those most likely to exist are drawn."""
SIGMAS = 2.0


def draw_detection_frame(frame: DetectionFrame, score: FrameScore, is_3d: bool) -> Figure:
    """Draw objects, detections with ellipses of two σ of their centres, and the likeliest pairs.

    The opacity of a detection is its probability of existence.
    """
    figure = Figure(figsize=(5.4, 5.0), layout="constrained")
    axes = figure.subplots()
    boxes = frame.detected.boxes
    existence = frame.detected.log_existence.exp().numpy()
    mean, state = boxes.mean.numpy(), frame.objects.state.numpy()
    yaw = boxes.yaw.numpy() if boxes.yaw is not None else np.zeros(len(mean))
    true_yaw = frame.objects.yaw.numpy() if frame.objects.yaw is not None else np.zeros(len(state))
    covariance = (boxes.chol @ boxes.chol.mT).numpy()
    seen, title = np.flatnonzero(existence >= MIN_EXISTENCE), ""
    if len(seen) > MAX_DRAWN:
        title = f"the {MAX_DRAWN:,} likeliest of {len(seen):,} detections"
        seen = seen[np.argsort(-existence[seen], kind="stable")[:MAX_DRAWN]]
    for i in seen:
        corners = _corners(mean[i], float(yaw[i]), is_3d)
        alpha = float(np.sqrt(existence[i]))
        axes.add_patch(Polygon(corners, fill=False, edgecolor=DETECTION, alpha=alpha, linewidth=1.2))
        _draw_ellipse(axes, corners.mean(0), _centre_covariance(covariance[i], is_3d), alpha)
    for j, i in enumerate(score.objects.best):
        corners = _corners(state[j], float(true_yaw[j]), is_3d)
        axes.add_patch(Polygon(corners, fill=False, edgecolor=OBJECT if i >= 0 else MISSED, linewidth=1.4))
        if i >= 0:
            pair = np.stack([corners.mean(0), _corners(mean[i], float(yaw[i]), is_3d).mean(0)])
            axes.plot(*pair.T, color=OBJECT, linewidth=1.0)
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    if not is_3d:
        axes.invert_yaxis()
    unit = "m" if is_3d else "px"
    style_axes(axes, title, f"x, {unit}", f"y, {unit}")
    return figure


def _corners(state: Float[ndarray, "D"], yaw: float, is_3d: bool) -> Float[ndarray, "4 2"]:
    # The state is left, top, right, bottom in images; in 3-D it begins with the centre and log sizes
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    if not is_3d:
        return 0.5 * (state[:2] + state[2:] + signs * (state[2:] - state[:2]))
    along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    half = 0.5 * np.exp(state[3:5]) * signs
    return state[:2] + half[:, :1] * along + half[:, 1:] * across


def _centre_covariance(covariance: Float[ndarray, "D D"], is_3d: bool) -> Float[ndarray, "2 2"]:
    if is_3d:
        return covariance[:2, :2]
    # The centre is a linear function of the sides, so its covariance follows from theirs
    middle = 0.5 * np.array([[1, 0, 1, 0], [0, 1, 0, 1]])
    return middle @ covariance @ middle.T


def _draw_ellipse(
    axes: Axes, centre: Float[ndarray, "2"], covariance: Float[ndarray, "2 2"], alpha: float
) -> None:
    # The eigenvectors are the axes of the ellipse
    variance, direction = np.linalg.eigh(covariance)
    width, height = 2 * SIGMAS * np.sqrt(variance)
    angle = np.degrees(np.arctan2(direction[1, 0], direction[0, 0]))
    axes.add_patch(
        Ellipse(
            (float(centre[0]), float(centre[1])),
            width,
            height,
            angle=angle,
            color=DETECTION,
            alpha=0.25 * alpha,
        )
    )


TITLES = {
    "d_ece": "Score and hits (2 m, or overlap 0.5)",
    "existence": "Existence and associations",
}


def draw_reliability(name: str, diagram: Reliability) -> Figure:
    """Draw outcome over confidence, with the diagonal of perfect calibration; bars show each bin's share."""
    figure = Figure(figsize=(4.6, 4.0), layout="constrained")
    axes = figure.subplots()
    full = diagram.count > 0
    centre = (np.arange(len(diagram.count)) + 0.5) / len(diagram.count)
    share = diagram.count / max(diagram.count.sum(), 1)
    axes.bar(centre, share, 0.9 / len(centre), color="#3f8efc40")
    axes.plot([0, 1], [0, 1], color=INK_MARK, linewidth=0.8, alpha=0.5)
    axes.plot(diagram.confidence[full], diagram.outcome[full], "o-", color="#3f8efc", markersize=4)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    title = f"{TITLES.get(name, name)}: error {diagram.error:.3f}"
    style_axes(axes, title, "confidence", "observed frequency")
    return figure


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
        diagrams=[inline_svg(draw_reliability(*diagram)) for diagram in scored.summary.diagrams.items()],
        frames=[
            (inline_svg(draw_detection_frame(frame, score, scored.detections.is_3d)), _caption(score))
            for frame, score in ranked[:worst]
        ],
        all_metrics=full_table(figures),
    )


def _caption(score: FrameScore) -> str:
    parts = ", ".join(f"{words(part)} {number(score.parts[part], 1)}" for part in PARTS)
    return f"{score.name}: {number(score.nll, 1)} nats ({parts})"
