"""A clip from above: x (forward) points up, y (left) points left, metres."""

import io
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from PIL import Image
from torch import Tensor

from foredrive.geometry.boxes import box_corners
from foredrive.scene import Boxes, Category, Clip, LidarSweep, MapKind, MapPatch, Trajectory
from foredrive.view import palette

EGO_OUTLINE_XY = np.array([[-1.0, 0.92], [2.4, 0.92], [3.1, 0.55], [3.1, -0.55], [2.4, -0.92], [-1.0, -0.92]])
"""A passenger car around its rear axle, m; the bevelled end is the front."""
AREA_KINDS = (MapKind.INTERSECTION, MapKind.WALKWAY, MapKind.CROSSWALK, MapKind.STOP_ZONE)
LINE_KINDS = (MapKind.LANE_CENTRE, MapKind.LANE_BOUNDARY, MapKind.ROAD_EDGE)
GRID_M = 10.0
MOVING_MPS = 0.5  # Slower boxes get no arrow


def draw_bev(ax: Axes, clip: Clip, reach_m: float, plan: Trajectory | None = None) -> None:
    """Draw a clip's present frame: map, lidar, boxes, the driven future and, if given, a plan.

    Args:
        ax: axes to draw in; the function sets their limits, ticks and colours.
        clip: without leading dimensions.
        reach_m: half the side of the square that is shown, centred on the rear axle.
        plan: without leading dimensions.
    """
    now = clip.now
    start_bev(ax, reach_m)
    if clip.map is not None:
        draw_map(ax, clip.map)
    if bool(clip.sweep_valid[now]):
        draw_sweep(ax, clip.sweeps[now], reach_m)
    if bool(clip.boxes_valid[now]):
        draw_boxes(ax, clip.boxes[now])
    draw_ego(ax)
    draw_path(ax, clip.future, palette.EXPERT)
    if plan is not None:
        draw_path(ax, plan, palette.PLAN)


def start_bev(ax: Axes, reach_m: float) -> None:
    """Set limits, aspect, a grid every 10 m and its labels."""
    ax.set_facecolor(palette.GROUND)
    # The horizontal axis is y, reversed, so that left is on the left
    ax.set(xlim=(reach_m, -reach_m), ylim=(-reach_m, reach_m), aspect="equal")
    step = GRID_M if reach_m <= 60 else 2 * GRID_M
    ticks = np.arange(-np.floor(reach_m / step), np.floor(reach_m / step) + 1) * step
    ax.set_xticks(ticks)
    ax.set_yticks(ticks)
    ax.grid(color=palette.GRID, linewidth=0.6)
    ax.set_axisbelow(True)
    ax.tick_params(colors=palette.FAINT, labelsize=9, length=0)
    ax.set_xlabel("y, left (m)", color=palette.FAINT, fontsize=9)
    ax.set_ylabel("x, forward (m)", color=palette.FAINT, fontsize=9)
    ax.spines[:].set_color(palette.GRID)


def start_path_map(
    ax: Axes, xy: Float[np.ndarray, "N 2"], margin_m: float, min_half_width_m: float
) -> tuple[Float[np.ndarray, "2"], float]:
    """Set the limits of a map to a square around a path, in world axes; return its centre and half width."""
    low, high = xy.min(axis=0) - margin_m, xy.max(axis=0) + margin_m
    (x, y), half = 0.5 * (low + high), max(0.5 * float((high - low).max()), min_half_width_m)
    ax.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal", xticks=[], yticks=[])
    ax.set_facecolor(palette.PANEL)
    ax.spines[:].set_visible(False)
    return np.array([x, y]), half


def draw_map(ax: Axes, patch: MapPatch) -> None:
    """Draw the map: areas filled, lines in the colour of their kind."""
    for kind in AREA_KINDS:
        outlines = _polylines(patch, kind)
        # Long outlines come in pieces, which are not closed and cannot be filled
        whole = [line for line in outlines if np.allclose(line[0], line[-1])]
        ax.add_collection(
            PolyCollection(
                whole, facecolor=palette.MAP_COLOURS[kind], alpha=0.22, edgecolor="none", zorder=1.0
            )
        )
        ax.add_collection(
            LineCollection(outlines, color=palette.MAP_COLOURS[kind], linewidth=0.7, alpha=0.6, zorder=1.1)
        )
    for kind in LINE_KINDS:
        style = (0, (4, 4)) if kind is MapKind.LANE_CENTRE else "solid"
        width = 1.2 if kind is MapKind.ROAD_EDGE else 0.8
        ax.add_collection(
            LineCollection(
                _polylines(patch, kind),
                color=palette.MAP_COLOURS[kind],
                linewidth=width,
                linestyle=style,
                zorder=1.2,
            )
        )


def draw_sweep(ax: Axes, sweep: LidarSweep, reach_m: float) -> None:
    """Draw returns as dots, coloured by range as in the images."""
    returned = sweep.returned & sweep.valid
    points, range_m = sweep.points_ego[returned], sweep.range_m[returned]
    shown = (points[:, :2].abs() < reach_m).all(-1)
    x, y = points[shown, 0].numpy(), points[shown, 1].numpy()
    colours = palette.range_colours(range_m[shown].numpy()) / 255
    ax.scatter(y, x, s=0.5, c=colours, linewidths=0, alpha=0.7, zorder=2, rasterized=True)


def draw_boxes(ax: Axes, boxes: Boxes) -> None:
    """Draw footprints coloured by category, with a thick front edge and an arrow of one second of motion."""
    kept = boxes[boxes.valid]
    # The first four corners are the footprint, and its first edge is the front. Horizontal axis first
    corners = box_corners(kept.centre, kept.size_lwh, kept.yaw)[:, :4, [1, 0]]  # [M 4 (y x)]
    outlines, fronts = list(corners.numpy()), list(corners[:, :2].numpy())
    colours = [palette.box_colour(c) for c in kept.category.tolist()]
    ax.add_collection(PolyCollection(outlines, facecolor=colours, edgecolor="none", alpha=0.30, zorder=3.0))
    ax.add_collection(
        PolyCollection(outlines, facecolor="none", edgecolor=colours, linewidth=1.1, zorder=3.1)
    )
    ax.add_collection(LineCollection(fronts, color=colours, linewidth=2.6, zorder=3.2))
    moving = _moving(kept)
    start, step = kept.centre[moving].numpy(), kept.velocity[moving].numpy()
    ax.quiver(
        start[:, 1],
        start[:, 0],
        step[:, 1],
        step[:, 0],
        color=[c for c, m in zip(colours, moving.tolist(), strict=True) if m],
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.0032,
        headwidth=4.5,
        headlength=5,
        zorder=3.3,
    )


def draw_ego(ax: Axes) -> None:
    """Draw the ego vehicle's footprint."""
    ax.add_patch(
        Polygon(
            EGO_OUTLINE_XY[:, ::-1], facecolor=palette.EGO, edgecolor=palette.GROUND, alpha=0.95, zorder=4
        )
    )


def draw_path(ax: Axes, path: Trajectory, colour: str) -> None:
    """Draw a trajectory's first alternative from the rear axle on, with a dot at each valid waypoint."""
    xy = path_points(path).numpy()
    if len(xy) > 1:
        ax.plot(xy[:, 1], xy[:, 0], color=colour, linewidth=2.2, zorder=5, solid_capstyle="round")
        ax.plot(
            xy[1:, 1], xy[1:, 0], "o", color=colour, markersize=5, markeredgecolor=palette.GROUND, zorder=5.1
        )


def path_points(path: Trajectory) -> Float[Tensor, "K 3"]:
    """Return origin and valid waypoints of the first alternative, on the ground (z = 0) of the ego frame."""
    xy = path.xy[0][path.valid[0]]
    return torch.nn.functional.pad(torch.cat([torch.zeros_like(xy[:1]), xy]), (0, 1))


def legend_handles(clip: Clip, plan: Trajectory | None = None) -> list[Artist]:
    """Return a legend of the kinds that this clip shows."""
    now = clip.now
    handles: list[Artist] = [Patch(facecolor=palette.EGO, label="ego vehicle")]
    if bool(clip.future.valid.any()):
        handles.append(Line2D([], [], color=palette.EXPERT, marker="o", markersize=4, label="driven future"))
    if plan is not None:
        handles.append(Line2D([], [], color=palette.PLAN, marker="o", markersize=4, label="planned"))
    if bool(clip.boxes_valid[now]):
        boxes = clip.boxes[now]
        present = sorted(set(boxes.category[boxes.valid].tolist()) & set(Category))
        handles += [Patch(color=palette.box_colour(c), label=palette.label(Category(c))) for c in present]
        if bool(_moving(boxes[boxes.valid]).any()):
            handles.append(
                Line2D([], [], color=palette.FAINT, marker=">", markersize=5, label="motion in 1 s")
            )
    if clip.map is not None:
        for kind in (*LINE_KINDS, *AREA_KINDS):
            if bool((clip.map.kind == kind).any()):
                handles.append(Line2D([], [], color=palette.MAP_COLOURS[kind], label=palette.label(kind)))
    return handles


def _moving(boxes: Boxes) -> Bool[Tensor, " M"]:
    return boxes.velocity.norm(dim=-1).nan_to_num(0) >= MOVING_MPS


def _polylines(patch: MapPatch, kind: MapKind) -> list[Float[np.ndarray, "V 2"]]:
    """Return the (y, x) vertices of every polyline of one kind."""
    lines = []
    for index in (patch.kind == kind).nonzero()[:, 0].tolist():
        xy = patch.vertices[index][patch.valid[index]][:, :2]
        if len(xy) > 1:
            lines.append(xy.flip(-1).numpy())
    return lines


def with_legend(figure: Figure, handles: Sequence[Artist]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a figure with a legend below."""
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=4,
        frameon=False,
        labelcolor=palette.INK,
        fontsize=8.5,
        handlelength=1.3,
        columnspacing=1.1,
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor=palette.GROUND)
    return np.asarray(Image.open(buffer).convert("RGB"))
