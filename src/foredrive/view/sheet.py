"""A dark picture with a layout in pixels from its upper left corner."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from foredrive.files import atomic_path
from foredrive.view import palette

DPI = 100
PT_PER_PX = 1.15
"""Points of font size per pixel of letter width, at which a title fits."""


class Sheet:
    """A figure of a given size.

    Args:
        width, height: size, px.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        size_in = (width / DPI, height / DPI)
        self.figure = Figure(figsize=size_in, dpi=DPI, facecolor=palette.GROUND)

    def place(self, x: int, y: int, w: int, h: int) -> Axes:
        """Add axes at a rectangle, px."""
        box = (x / self.width, 1 - (y + h) / self.height, w / self.width, h / self.height)
        return self.figure.add_axes(box)

    def write(
        self, x: int, y: int, text: str, size_pt: float, colour: str = palette.INK, weight: str = "normal"
    ) -> None:
        """Write lines of text below a point; a dollar sign starts no formula."""
        position = (x / self.width, 1 - y / self.height)
        written = self.figure.text(
            *position, text, color=colour, fontsize=size_pt, va="top", parse_math=False
        )
        written.set(linespacing=1.5 if "\n" in text else 1.2, weight=weight)

    def head(self, x: int, height: int, text: str, size_pt: float) -> None:
        """Write a title into the middle of the upper margin; shrink a long one to fit."""
        size_pt = min(size_pt, PT_PER_PX * self.width / max(len(text), 1))
        position = (x / self.width, 1 - height / 2 / self.height)
        self.figure.text(*position, text, color=palette.INK, fontsize=size_pt, va="center", parse_math=False)

    def save(self, path: Path) -> None:
        """Write the picture as a PNG; it is written completely or not at all."""
        with atomic_path(path) as scratch:
            self.figure.savefig(scratch, dpi=DPI, facecolor=palette.GROUND, format="png")
