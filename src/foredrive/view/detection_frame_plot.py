"""Objects and uncertain detections of one frame: from above in metres, or in the image in pixels."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon
from numpy import ndarray

from foredrive.evaluation.detections.frames import DetectionFrame
from foredrive.evaluation.detections.score import FrameScore
from foredrive.view.html import style_axes

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
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    if not is_3d:
        return 0.5 * (state[:2] + state[2:] + signs * (state[2:] - state[:2]))
    along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    half = 0.5 * np.exp(state[3:5]) * signs
    return state[:2] + half[:, :1] * along + half[:, 1:] * across


def _centre_covariance(covariance: Float[ndarray, "D D"], is_3d: bool) -> Float[ndarray, "2 2"]:
    if is_3d:
        return covariance[:2, :2]
    middle = 0.5 * np.array([[1, 0, 1, 0], [0, 1, 0, 1]])
    return middle @ covariance @ middle.T


def _draw_ellipse(
    axes: Axes, centre: Float[ndarray, "2"], covariance: Float[ndarray, "2 2"], alpha: float
) -> None:
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
