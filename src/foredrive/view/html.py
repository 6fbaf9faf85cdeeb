"""Self-contained pages from the templates beside this file; all inserted values are escaped."""

import base64
import functools
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from foredrive.engine.summary import Summary
from foredrive.files import atomic_path
from foredrive.view.table import Cell, Value, number, words

INK_MARK = "#010203"
"""Placeholder colour in figures, which is replaced by the page's text colour."""
NO_METADATA = {"Date": None, "Creator": None, "Format": None, "Type": None}


@dataclass(frozen=True)
class Picture:
    """A picture inside a page."""

    source: str
    """A data URI."""
    caption: str
    width: int
    height: int


@dataclass(frozen=True)
class MetricTile:
    """One of the main metrics of a page."""

    name: str
    value: str
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Provenance:
    """The command, commit, machine and date of a summary."""

    command: str
    commit: str
    machine: str
    date: str = ""

    @classmethod
    def of(cls, summary: Summary, date: str = "") -> "Provenance":
        """Return the provenance that a summary states."""
        cores = summary.get("machine.cores")
        machine = [
            f"{cores} {'core' if cores == 1 else 'cores'} of {summary.get('machine.cpu')}",
            f"{summary.get('machine.ram_gib')} GiB",
            summary.get("machine.gpu"),
            f"Python {summary.get('version.python')}",
            f"torch {summary.get('version.torch')}",
        ]
        return cls(
            command=str(summary.get("command")),
            commit=str(summary.get("commit") or "not a git checkout"),
            machine=", ".join(str(part) for part in machine if part),
            date=date,
        )


def write_page(path: Path, template: str, **content: object) -> None:
    """Write one HTML file that loads no other file; it is written completely or not at all."""
    page = render_page(template, **content)
    with atomic_path(path) as scratch:
        scratch.write_text(page, encoding="utf-8")


def render_page(template: str, **content: object) -> str:
    """Render a template of this folder; escape every value that is not `Markup`."""
    return _environment().get_template(template).render(**content)


def picture(
    image: UInt8[np.ndarray, "H W 3"], caption: str, kind: Literal["jpeg", "png"] = "jpeg"
) -> Picture:
    """Encode an image for a page."""
    buffer = io.BytesIO()
    options = {"quality": 90, "subsampling": 0} if kind == "jpeg" else {"optimize": True}
    Image.fromarray(image).save(buffer, format=kind, **options)
    data = base64.b64encode(buffer.getvalue()).decode()
    return Picture(f"data:image/{kind};base64,{data}", caption, image.shape[1], image.shape[0])


def stored_film(path: Path, caption: str) -> Picture:
    """Encode an animated WebP from a file, which browsers show as a picture, for a page."""
    with Image.open(path) as film:
        width, height = film.size
    data = base64.b64encode(path.read_bytes()).decode()
    return Picture(f"data:image/webp;base64,{data}", caption, width, height)


def inline_svg(figure: Figure) -> Markup:
    """Draw a figure as SVG with the page's width, font and text colour; matplotlib escapes its texts."""
    # Texts stay texts in the page's font. A fixed salt gives equal pages for equal figures
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "foredrive"}):
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata=NO_METADATA)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(INK_MARK, "currentColor")
    # Without its own size the drawing fills the width of its place
    svg = re.sub(r'\s(width|height)="[\d.]+pt"', "", svg, count=2)
    return Markup(re.sub(r"font-family: '?DejaVu Sans[^;\"]*", "font-family: inherit", svg))


def style_axes(ax: Axes, title: str = "", xlabel: str = "", ylabel: str = "") -> None:
    """Give axes the page's colours, a faint grid and no frame."""
    ax.set_title(title, color=INK_MARK, loc="left", fontsize=10)
    ax.set_xlabel(xlabel, color=INK_MARK, fontsize=9)
    ax.set_ylabel(ylabel, color=INK_MARK, fontsize=9)
    ax.tick_params(which="both", colors=INK_MARK, length=0, labelsize=9)
    ax.grid(color="#8888884d", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.spines[:].set_visible(False)


@functools.cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("foredrive.view"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"number": number, "words": words, "cell": _cell, "breakable": _breakable}
    return environment


def _breakable(text: str) -> Markup:
    """Allow line breaks in a long name of a log at its slashes and before its time, but not within words."""
    return Markup("<wbr>@").join(Markup("/<wbr>").join(part.split("/")) for part in text.split("@"))


def _cell(value: Value | Cell) -> Cell:
    return value if isinstance(value, Cell) else Cell(value)
