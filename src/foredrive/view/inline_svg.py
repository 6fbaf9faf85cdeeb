"""Figures of matplotlib as part of a page."""

import io
import re

from matplotlib import rc_context
from matplotlib.figure import Figure

INK_MARK = "#010203"
"""Drawn wherever the page's own text colour shall be."""
NO_METADATA = {"Date": None, "Creator": None, "Format": None, "Type": None}


def inline_svg(figure: Figure) -> str:
    """SVG of the page's width, in its font and text colour."""
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "foredrive"}):
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata=NO_METADATA)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(INK_MARK, "currentColor")
    svg = re.sub(r'\s(width|height)="[\d.]+pt"', "", svg, count=2)
    return re.sub(r"font-family: '?DejaVu Sans[^;\"]*", "font-family: inherit", svg)
