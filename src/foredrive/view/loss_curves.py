"""Loss curves as an inline SVG in the page's text colour."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from foredrive.view.html import INK_MARK, inline_svg, style_axes

COLOURS = ("#3f8efc", "#f2803c", "#2eb67d", "#d1559b", "#a78bfa", "#c9a227", "#e5484d")
NOT_LOSSES = ("step", "step_s", "cpu_s", "lr")
SMOOTH_STEPS = 15
LEGEND_COLUMNS = 5
Losses = Mapping[str, Sequence[Mapping[str, float | int]]]
"""For each stage the lines of its metrics file: "step" and a value for each loss."""


def draw_loss_curves(stages: Losses) -> Markup | None:
    """Draw a chart for each stage: values faint, their running mean strong, on a logarithmic scale.

    Returns:
        SVG, or None if no stage has any lines.
    """
    shown = {name: lines for name, lines in stages.items() if lines}
    if not shown:
        return None
    figure = Figure(figsize=(5.2 * len(shown), 3.1), layout="constrained")
    axes = figure.subplots(1, len(shown), squeeze=False)[0]
    for ax, (name, lines) in zip(axes, shown.items(), strict=True):
        _draw_stage(ax, name, lines)
    return inline_svg(figure)


def _draw_stage(ax: Axes, name: str, lines: Sequence[Mapping[str, float | int]]) -> None:
    names = [key for key in lines[0] if key not in NOT_LOSSES]
    names.sort(key=lambda key: key != "loss")  # The minimised loss comes first
    for key, colour in zip(names, COLOURS, strict=False):
        steps = np.array([line["step"] for line in lines if key in line], dtype=float)
        values = np.array([line[key] for line in lines if key in line], dtype=float)
        if not (values > 0).any():
            continue
        positive = np.where(values > 0, values, np.nan)
        ax.plot(steps, positive, color=colour, linewidth=0.8, alpha=0.3)
        ax.plot(steps, _running_mean(positive), color=colour, linewidth=1.9, label=key)
    ax.set_yscale("log")
    style_axes(ax, name, "step")
    if ax.lines:
        legend_rows = math.ceil(len(names) / LEGEND_COLUMNS)
        ax.legend(
            frameon=False,
            labelcolor=INK_MARK,
            fontsize=9,
            loc="lower right",
            bbox_to_anchor=(1.0, 0.98),
            ncols=math.ceil(len(names) / legend_rows),
            handlelength=1.2,
            columnspacing=1.2,
        )


def _running_mean(values: Float[np.ndarray, " S"]) -> Float[np.ndarray, " S"]:
    """Return the mean of the last few finite values at each step."""
    number = np.isfinite(values)
    total = np.cumsum(np.where(number, values, 0.0))
    count = np.cumsum(number)
    # The difference of two cumulative sums is the sum over the last few steps
    total[SMOOTH_STEPS:] -= total[:-SMOOTH_STEPS].copy()
    count[SMOOTH_STEPS:] -= count[:-SMOOTH_STEPS].copy()
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
