"""Where the images of a reconstruction are trusted: a table, a map from above, and JSON."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
from matplotlib.figure import Figure

from foredrive.engine.provenance import collect_provenance
from foredrive.engine.summary import write_json
from foredrive.files import atomic_path
from foredrive.methods.reconstruction.trust import TRUSTED_LOSS_DB
from foredrive.runs.reconstruction.reconstruction_run import OpenedReconstruction
from foredrive.runs.reconstruction.trust import TrustedPlace
from foredrive.view.table import Column, Row, Section, Table

ARROW_IN = 0.4
"""Length of the arrow of a place, inches."""
WORST_LOSS_DB = 8.0
"""Loss at the end of the colour scale."""


def trust_table(reference_db: float, places: Sequence[TrustedPlace]) -> Table:
    """Return the share of trusted moments by offset and heading, in percent."""
    offsets_m, headings_deg = (
        sorted({getattr(place, name) for place in places}, reverse=True) for name in ("left_m", "left_deg")
    )
    rows = [
        Row(
            [
                _aside(left_m),
                *(
                    100 * fmean(p.trusted for p in places if (p.left_m, p.left_deg) == (left_m, left_deg))
                    for left_deg in headings_deg
                ),
            ]
        )
        for left_m in offsets_m
    ]
    columns = [
        Column("moments trusted, %", align="left"),
        *(Column(_turned(x), digits=0) for x in headings_deg),
    ]
    notes = [
        f"along the logged way, images have {reference_db:.1f} dB; a moment is trusted if at most "
        f"{TRUSTED_LOSS_DB:g} dB less are expected"
    ]
    return Table(columns, [Section(rows)], notes=notes)


def _aside(left_m: float) -> str:
    return f"{abs(left_m):g} m {'left' if left_m > 0 else 'right'}" if left_m else "logged way"


def _turned(left_deg: float) -> str:
    return f"{abs(left_deg):g}° {'left' if left_deg > 0 else 'right'}" if left_deg else "straight"


def write_trust_json(path: Path, reference_db: float, places: Sequence[TrustedPlace]) -> None:
    """Write all places with their expected quality."""
    write_json(
        path,
        {
            "reference_db": reference_db,
            "trusted_loss_db": TRUSTED_LOSS_DB,
            "trusted_share": fmean(place.trusted for place in places),
            "places": [dataclasses.asdict(place) for place in places],
            **collect_provenance(),
        },
    )


def write_trust_map(
    path: Path, opened: OpenedReconstruction, reference_db: float, places: Sequence[TrustedPlace]
) -> None:
    """Draw the places from above, beside the logged way as a straight line: an arrow for each heading."""
    t_s, left_m, left_deg, psnr_db = (
        np.array([getattr(place, name) for place in places])
        for name in ("t_s", "left_m", "left_deg", "psnr_db")
    )
    moments = len(set(t_s.tolist()))
    figure = Figure(figsize=(min(max(6.0, 2.0 + 1.1 * moments), 20.0), 6.5), layout="constrained")
    axes = figure.subplots()
    axes.set_facecolor("0.15")  # The middle of the colour scale is pale
    axes.axhline(0.0, color="0.5", linewidth=1, zorder=0)
    arrows = axes.quiver(
        *(t_s, left_m, np.cos(np.radians(left_deg)), np.sin(np.radians(left_deg))),
        reference_db - psnr_db,
        cmap="RdYlGn_r",
        scale_units="inches",
        scale=1 / ARROW_IN,
        width=0.02,
        units="inches",
        headwidth=3,
    )
    arrows.set_clim(0.0, WORST_LOSS_DB)
    trusted = np.array([place.trusted for place in places])
    axes.scatter(
        t_s[trusted], left_m[trusted], s=10, color="white", zorder=3, label="trusted for some heading"
    )
    step_s = (t_s.max() - t_s.min()) / max(moments - 1, 1) or 1.0
    axes.set_xlim(t_s.min() - 0.3 * step_s, t_s.max() + step_s)
    axes.set_ylim(left_m.min() - 1.0, left_m.max() + 1.0)
    axes.set_xlabel("time of the log, s")
    axes.set_ylabel("to the left of the logged way, m")
    axes.set_title(f"{opened.folder.name}: expected loss against the logged way ({reference_db:.1f} dB)")
    figure.legend(loc="outside lower left", frameon=True, facecolor="0.3", labelcolor="white")
    figure.colorbar(arrows, ax=axes, label="loss of PSNR, dB", shrink=0.8)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
