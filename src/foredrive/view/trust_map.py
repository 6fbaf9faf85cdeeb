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

ARROW_M = 0.9
"""Length of the arrow of a place, m: half of the distance between places."""
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
    """Draw the places from above: an arrow for each heading, in the colour of the expected loss."""
    way = opened.vehicle.T_scene_ego[:, :2, 3].numpy()
    span = np.ptp(np.concatenate([way, np.array([place.xy for place in places])]), axis=0)
    width = 12.0
    figure = Figure(figsize=(width, float(np.clip(width * span[1] / max(span[0], 1.0), 3.0, 12.0)) + 1.0))
    axes = figure.subplots()
    axes.plot(*way.T, color="0.6", linewidth=1, zorder=0)
    headings_rad = np.array([_heading_rad(opened, place) for place in places])
    xy = np.array([place.xy for place in places])
    loss_db = np.array([reference_db - place.psnr_db for place in places])
    arrows = axes.quiver(
        *xy.T,
        ARROW_M * np.cos(headings_rad),
        ARROW_M * np.sin(headings_rad),
        loss_db,
        cmap="RdYlGn_r",
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.0014,
        headwidth=4,
    )
    arrows.set_clim(0.0, WORST_LOSS_DB)
    trusted = np.array([place.trusted for place in places])
    x, y = xy[trusted].T
    axes.scatter(x, y, s=6, color="0.1", zorder=3, label="trusted for some heading")
    axes.set_aspect("equal")
    axes.set_xlabel("m, along the first heading of the log")
    axes.set_ylabel("m")
    axes.set_title(
        f"{opened.folder.name}: expected loss of PSNR against the logged way ({reference_db:.1f} dB)"
    )
    axes.legend(loc="upper left", frameon=False)
    figure.colorbar(arrows, ax=axes, label="loss, dB", shrink=0.8)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110, bbox_inches="tight", format="png")


def _heading_rad(opened: OpenedReconstruction, place: TrustedPlace) -> float:
    forward = opened.vehicle.at(place.t_s).T_scene_ego[:2, 0].numpy()
    return float(np.arctan2(forward[1], forward[0]) + np.radians(place.left_deg))
