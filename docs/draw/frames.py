"""Draws docs/frames.png, the picture of the conventions page: `python docs/draw/frames.py`."""

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

X, Y, Z = "#d1495b", "#2e933c", "#2660a4"


def arrow(ax: Axes, start: tuple[float, float], step: tuple[float, float], colour: str, label: str) -> None:
    """An axis of a frame, with its name beyond the tip."""
    tip = (start[0] + step[0], start[1] + step[1])
    ax.annotate("", tip, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2.2})
    ax.text(
        start[0] + 1.22 * step[0], start[1] + 1.22 * step[1], label, color=colour, ha="center", va="center"
    )


def dot(ax: Axes, at: tuple[float, float], colour: str, label: str, towards: bool) -> None:
    """An axis that points out of the page (dot) or into it (cross)."""
    ax.plot(*at, "o", ms=11, mfc="white", mec=colour, mew=1.8, zorder=5)
    ax.plot(*at, "." if towards else "x", color=colour, ms=7, zorder=6)
    ax.text(at[0] - 0.18, at[1] - 0.28, label, color=colour, ha="right", va="center")


def main() -> None:
    """Side view with ego and camera frames; top view with boxes, yaw and the trajectory."""
    plt.rcParams.update({"font.size": 10.5, "font.family": "DejaVu Sans"})
    fig, (side, top) = plt.subplots(1, 2, figsize=(11.5, 4.0), width_ratios=[1.05, 1])

    side.plot([-1.6, 6.6], [0, 0], color="#777", lw=1.5)
    body = [(-0.9, 0.3), (-0.9, 0.95), (0.1, 1.5), (2.0, 1.5), (2.7, 0.95), (3.8, 0.8), (3.8, 0.3)]
    side.fill(*zip(*body, strict=True), color="#e3e6ec", ec="#9aa3b2", lw=1.2)
    for wheel in (0.0, 2.9):
        side.add_patch(plt.Circle((wheel, 0.33), 0.33, color="#4a4f59"))
    arrow(side, (0, 0), (1.5, 0), X, "x")
    arrow(side, (0, 0), (0, 1.15), Z, "z")
    dot(side, (0, 0), Y, "y", towards=False)
    side.text(0.0, -0.62, "ego: rear axle, on the ground", ha="center")
    arrow(side, (1.9, 1.75), (1.5, 0), Z, "z")
    arrow(side, (1.9, 1.75), (0, -0.85), Y, "y")
    dot(side, (1.9, 1.75), X, "x", towards=True)
    side.text(2.1, 2.12, "cam: T_ego_cam maps cam → ego", ha="left")
    side.set(xlim=(-2.0, 6.8), ylim=(-1.0, 2.7), aspect="equal", title="from the right")

    top.add_patch(plt.Rectangle((-0.9, -0.9), 4.7, 1.8, color="#e3e6ec", ec="#9aa3b2", lw=1.2))
    arrow(top, (0, 0), (1.4, 0), X, "x")
    arrow(top, (0, 0), (0, 1.4), Y, "y")
    dot(top, (0, 0), Z, "z", towards=True)
    path = [(1.2 * k + 2.4, 0.035 * k * k) for k in range(1, 7)]
    top.plot(*zip(*path, strict=True), "o-", color="#7a4ea3", ms=4.5, lw=1.2)
    top.text(6.0, -0.55, "trajectory: first point at t = dt", color="#7a4ea3", ha="center")
    box = mpl.transforms.Affine2D().rotate(0.5).translate(7.0, 3.0) + top.transData
    top.add_patch(plt.Rectangle((-1.2, -0.5), 2.4, 1.0, fill=False, ec="#b4690e", lw=2, transform=box))
    top.plot([7.0, 8.5], [3.0, 3.0], ":", color="#b4690e")
    arrow(top, (7.0, 3.0), (1.25, 0.68), "#b4690e", "l")
    top.text(8.75, 3.05, "yaw", color="#b4690e", va="center")
    top.text(6.9, 1.75, "box: centre and size l, w, h", color="#b4690e", ha="center")
    top.set(xlim=(-1.6, 10.0), ylim=(-1.5, 4.4), aspect="equal", title="from above")
    for ax in (side, top):
        ax.axis("off")
    fig.tight_layout()
    fig.savefig(Path(__file__).parents[1] / "frames.png", dpi=110)


if __name__ == "__main__":
    main()
