"""Figures of one closed-loop drive: its path and its speed."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.scores import InfractionKind
from foredrive.driving.time_to_collision import NEAR_COLLISION_S
from foredrive.towns.map.loading import load_town_map
from foredrive.view import palette
from foredrive.view.bev import start_path_map
from foredrive.view.html import style_axes

MARGIN_M, MIN_HALF_WIDTH_M = 25.0, 45.0
PLACES_M = 60.0
"""Margin of lanes around places, m."""
MAX_SHOWN_MPS = 14.0
SPEED_MAP, DARKEST = "plasma", -0.35
"""Lower end of the speed colours, as a part of `MAX_SHOWN_MPS`. It keeps a standing vehicle away from the
darkest colours, which look like the road.
"""
ROAD = "#333d4b"
LETTERS = {
    InfractionKind.COLLISION_PEDESTRIAN: "P",
    InfractionKind.COLLISION_VEHICLE: "V",
    InfractionKind.COLLISION_STATIC: "S",
    InfractionKind.RED_LIGHT: "R",
    InfractionKind.STOP_SIGN: "H",
    InfractionKind.SCENARIO_TIMEOUT: "T",
    InfractionKind.YIELD_TO_EMERGENCY: "Y",
    InfractionKind.MIN_SPEED: "M",
}
"""The letter that marks each kind of infraction in the figures."""


def draw_drive_path(drive: DriveRecord) -> Figure:
    """Draw the route over the town's lanes, and the driven path coloured by speed.

    North is up. Infractions and scenarios are marked. Without a town there are no lanes.
    """
    figure = Figure(figsize=(4.6, 4.6))
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    route, track = np.array(drive.route_xy), np.array(drive.track.xy)
    centre, half = start_path_map(ax, np.concatenate([route, track]), MARGIN_M, MIN_HALF_WIDTH_M)
    ax.add_patch(Rectangle((0, 0), 1, 1, transform=ax.transAxes, facecolor=palette.PANEL, zorder=0))
    if drive.town is not None:
        _draw_lanes(ax, drive.town, centre, half)
    ax.plot(*route.T, color=palette.FAINT, linewidth=6.0, alpha=0.5, solid_capstyle="round", zorder=2)
    ax.plot(*route[-1], "o", color=palette.EXPERT, markersize=9, markerfacecolor="none", zorder=4)
    if len(track) > 1:
        pieces = LineCollection(
            list(np.stack([track[:-1], track[1:]], axis=1)),
            # One piece for each step, coloured by the speed at its end
            array=np.array(drive.track.speed_mps[1:]),
            cmap=SPEED_MAP,
            norm=Normalize(DARKEST * MAX_SHOWN_MPS, MAX_SHOWN_MPS),
            linewidth=2.4,
            capstyle="round",
            zorder=3,
        )
        ax.add_collection(pieces)
    ax.plot(*track[0], "o", color=palette.EGO, markersize=5, zorder=4)
    for _, xy, text, style in _marks(drive):
        ax.text(xy[0], xy[1], text, zorder=6, va="center_baseline", **style)
    scale_m = 20.0 if half < 120 else 100.0
    x, y = centre[0] - 0.92 * half, centre[1] - 0.92 * half
    ax.plot([x, x + scale_m], [y, y], color=palette.INK, linewidth=1.5)
    ax.text(x, y + 0.02 * half, f"{scale_m:.0f} m", color=palette.INK, fontsize=8, va="bottom")
    return figure


def letter_of(kind: str) -> str:
    """Return the letter of an `InfractionKind`, or the first one of another word."""
    return LETTERS[InfractionKind(kind)] if kind in set(InfractionKind) else kind[0]


def draw_places(town: str, places: Sequence[tuple[Sequence[float], str]]) -> Figure:
    """Draw places in a town, each with the kind of its event: letters as in the maps of drives.

    Args:
        places: position in the world, and the kind, see `letter_of`.
    """
    figure = Figure(figsize=(4.6, 4.6))
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    lanes = np.concatenate([lane.centreline_xyz[:, :2] for lane in load_town_map(town).lanes])
    xy = np.array([place for place, _ in places])
    inside = (lanes > xy.min(0) - PLACES_M).all(1) & (lanes < xy.max(0) + PLACES_M).all(1)
    centre, half = start_path_map(ax, np.concatenate([xy, lanes[inside]]), MARGIN_M, MIN_HALF_WIDTH_M)
    ax.add_patch(Rectangle((0, 0), 1, 1, transform=ax.transAxes, facecolor=palette.PANEL, zorder=0))
    _draw_lanes(ax, town, centre, half)
    style = _style("circle", palette.PLAN) | {"fontsize": 13}  # the page shows several maps in a row
    for place, kind in places:
        ax.text(place[0], place[1], letter_of(kind), zorder=6, va="center_baseline", **style)
    return figure


def draw_timeline(drive: DriveRecord) -> Figure:
    """Draw speed over time, with marks for scenarios and infractions and shaded times of near collisions."""
    figure = Figure(figsize=(7.6, 2.3))
    ax = figure.add_axes((0.07, 0.22, 0.90, 0.70))  # Room on the right for half of the last label
    t_s, speed = drive.track.t_s, drive.track.speed_mps
    ax.fill_between(t_s, speed, color="#4c8be0", alpha=0.25, linewidth=0)
    ax.plot(t_s, speed, color="#4c8be0", linewidth=1.6)
    top = max(6.0, 1.25 * max(speed, default=0.0))
    ax.set(xlim=(0.0, max(drive.score.duration_s, 1.0)), ylim=(0.0, top))
    for t0, t1 in _near(drive.nearest_s):
        ax.axvspan(t0, t1, color="#e0a458", alpha=0.3, linewidth=0)
    for at_s, _, text, style in _marks(drive):
        ax.axvline(at_s, color=style["bbox"]["facecolor"], linewidth=1.4)
        ax.text(at_s, 0.96 * top, text, va="top", **style)
    style_axes(ax, xlabel="time, s", ylabel="speed, m/s")
    return figure


def _draw_lanes(ax: Axes, town: str, centre: Float[np.ndarray, "2"], half: float) -> None:
    areas, lines = [], []
    for lane in load_town_map(town).lanes:
        line = lane.centreline_xyz[:, :2]
        if (np.abs(line - centre) < half).all(axis=1).any():
            left, right = lane.left_boundary_xyz[:, :2], lane.right_boundary_xyz[:, :2]
            areas.append(np.concatenate([left, right[::-1]]).round(1))
            lines.append(line.round(1))
    ax.add_collection(PolyCollection(areas, facecolor=ROAD, edgecolor=ROAD, linewidth=0.8, zorder=1))
    ax.add_collection(LineCollection(lines, color="#465266", linewidth=0.5, zorder=1.1))


def _marks(drive: DriveRecord) -> list[tuple[float, Sequence[float], str, dict[str, Any]]]:
    """Return time (s), world position, text and text style of each mark; infractions come last, on top."""
    marks = [
        (event.t_s, event.xy_world, str(number), _style("square", palette.SCENARIO))
        for number, event in enumerate(drive.scenario_events, start=1)
    ]
    return marks + [
        (infraction.t_s, infraction.xy_world, LETTERS[infraction.kind], _style("circle", palette.PLAN))
        for infraction in drive.score.infractions
    ]


def _style(shape: str, colour: str) -> dict[str, Any]:
    box = {"boxstyle": f"{shape},pad=0.25", "facecolor": colour, "edgecolor": "white", "linewidth": 0.6}
    return {"color": "white", "fontsize": 8, "weight": "bold", "ha": "center", "bbox": box}


def _near(nearest_s: Sequence[float | None]) -> list[tuple[float, float]]:
    """Return the spans of time, s, in which the time to collision was below nuPlan's bound."""
    return [
        (FRAME_DT_S * (k - 0.5), FRAME_DT_S * (k + 0.5))
        for k, seconds in enumerate(nearest_s)
        if seconds is not None and seconds < NEAR_COLLISION_S
    ]
