"""Reliability diagrams: the share of correct detections over their confidence."""

import numpy as np
from matplotlib.figure import Figure

from foredrive.metrics.reliability import Reliability
from foredrive.view.html import INK_MARK, style_axes

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
