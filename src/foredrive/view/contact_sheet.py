"""A sheet of many drives: a few images of the front camera and the path through the town for each."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from foredrive.data import LogPath
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.commands import command_at
from foredrive.data.logs import Log
from foredrive.data.maps import RADIUS_M, read_map_patch
from foredrive.geometry.polylines import arc_lengths
from foredrive.scene import Command, MapKind, MapPatch
from foredrive.view import palette
from foredrive.view.bev import start_path_map
from foredrive.view.sheet import Sheet

THUMBNAIL_HW = (126, 224)
THUMBNAILS = 5
GAP_PX, HEAD_PX, TEXT_PX = 8, 52, 270
MAX_NAME_PT, PT_PER_PX = 12.0, 0.86
"""All names share one font size, at which the longest name fits: the maximum size, and points per pixel of
letter width.
"""
MAX_ROWS = 60
"""Maximum number of drives; more drives are thinned out evenly."""
MARGIN_M = 30.0
MIN_HALF_WIDTH_M = 50.0
"""Margin of the view from above around the path, and its minimum half width, m."""
MAP_LINES = {MapKind.LANE_BOUNDARY: 0.5, MapKind.ROAD_EDGE: 0.9}
HORIZON_STEPS, HORIZON_DT_S = 6, 0.5


def write_contact_sheet(path: Path, drives: Sequence[tuple[LogPath, str]]) -> None:
    """Write a PNG with one row for each drive, in the given order.

    Args:
        path: path of the picture; it is written completely or not at all.
        drives: logs, each with a caption.

    Raises:
        InputError: a log cannot be read.
    """
    chosen = np.linspace(0, len(drives) - 1, min(len(drives), MAX_ROWS)).round().astype(int).tolist()
    (cell_h, cell_w), row_h = THUMBNAIL_HW, THUMBNAIL_HW[0] + GAP_PX
    width = TEXT_PX + THUMBNAILS * (cell_w + GAP_PX) + cell_h + 2 * GAP_PX
    height = HEAD_PX + len(chosen) * row_h
    sheet = Sheet(width, height)
    # All names get one font size, at which the longest fits into its column
    longest = max(len(drives[index][0].folder.name) for index in chosen)
    name_pt = min(MAX_NAME_PT, PT_PER_PX * TEXT_PX / longest)
    commanded: Counter[str] = Counter()
    for row, index in enumerate(chosen):
        y, (drive, caption) = HEAD_PX + row * row_h, drives[index]
        log = Log(drive)
        commands = _commands(log)
        commanded += commands
        sheet.write(2 * GAP_PX, y, log.path.folder.name, name_pt, weight="bold")
        sheet.write(2 * GAP_PX, y + cell_h // 5, _summary_text(log, caption, commands), 9.5, palette.FAINT)
        for column, frame in enumerate(_spread(len(log))):
            _show_front(sheet.place(TEXT_PX + column * (cell_w + GAP_PX), y, cell_w, cell_h), log, frame)
        draw_drive_path(sheet.place(TEXT_PX + THUMBNAILS * (cell_w + GAP_PX), y, cell_h, cell_h), log)
    shown = (
        f"{len(drives)} drives" if len(chosen) == len(drives) else f"{len(chosen)} of {len(drives)} drives"
    )
    sheet.head(2 * GAP_PX, HEAD_PX, f"{shown}    commands: {_shares(commanded)}", 14.0)
    sheet.save(path)


def _spread(frames: int) -> list[int]:
    """Choose frames evenly from the first to the last."""
    return np.linspace(0, frames - 1, min(frames, THUMBNAILS)).round().astype(int).tolist()


def _commands(log: Log) -> Counter[str]:
    """Count the frames of each command."""
    counts: Counter[str] = Counter()
    for frame in range(len(log)):
        command, _ = command_at(log, frame, log.driven_future(frame, HORIZON_STEPS, HORIZON_DT_S))
        if command is not None:
            counts[palette.label(command)] += 1
    return counts


def _shares(commands: Counter[str]) -> str:
    total = max(commands.total(), 1)
    kinds = [palette.label(kind) for kind in Command if commands[palette.label(kind)]]
    return "   ".join(f"{kind} {100 * commands[kind] / total:.0f} %" for kind in kinds)


def _summary_text(log: Log, caption: str, commands: Counter[str]) -> str:
    length_m = float(np.linalg.norm(np.diff(log.T_world_ego[:, :3, 3], axis=0), axis=-1).sum())
    duration_s = float(log.t_us[-1] - log.t_us[0]) * 1e-6
    return f"{caption}\n{duration_s:.1f} s, {length_m:.0f} m\n{_shares(commands)}"


def _show_front(ax: Axes, log: Log, frame: int) -> None:
    ax.imshow(_front_image(log, frame), interpolation="none", aspect="auto")
    ax.set_axis_off()
    ax.text(
        0.02,
        0.96,
        f"{(log.t_us[frame] - log.t_us[0]) * 1e-6:.1f} s",
        transform=ax.transAxes,
        color=palette.INK,
        fontsize=8,
        va="top",
        bbox={"facecolor": palette.GROUND, "alpha": 0.6, "edgecolor": "none", "pad": 2},
    )


def _front_image(log: Log, frame: int) -> UInt8[np.ndarray, "H W 3"]:
    """Read the image of the first camera; return an empty panel if the log has none."""
    cameras = pinhole_cameras(log)
    if cameras:
        image = read_camera(log, frame, next(iter(cameras.values())), THUMBNAIL_HW, with_image=True).image
        if image is not None:
            return image.permute(1, 2, 0).numpy()
    return np.full((*THUMBNAIL_HW, 3), palette.rgb255(palette.PANEL), dtype=np.uint8)


def draw_drive_path(ax: Axes, log: Log) -> None:
    """Draw the driven path over the map, north up, with a dot at its start."""
    xy = log.T_world_ego[:, :2, 3]
    start_path_map(ax, xy, MARGIN_M, MIN_HALF_WIDTH_M)
    # Map patches have this radius, so their centres need not be closer
    for frame in _frames_every(xy, RADIUS_M):
        patch = read_map_patch(log, frame)
        for kind, width in MAP_LINES.items():
            lines = _lines_world(patch, kind, log.T_world_ego[frame])
            ax.add_collection(LineCollection(lines, color=palette.MAP_COLOURS[kind], linewidth=width))
    ax.plot(*xy.T, color=palette.EXPERT, linewidth=2.2, solid_capstyle="round", zorder=3)
    ax.plot(*xy[0], "o", color=palette.EGO, markersize=5, zorder=4)


def _frames_every(xy: Float[np.ndarray, "F 2"], step_m: float) -> list[int]:
    """Return the first frame, the last, and those that are `step_m` of driving apart."""
    driven_m = arc_lengths(xy)
    frames = np.searchsorted(driven_m, np.arange(0, driven_m[-1], step_m))
    return sorted({*frames.tolist(), len(xy) - 1})


def _lines_world(
    patch: MapPatch, kind: MapKind, T_world_ego: Float[np.ndarray, "4 4"]
) -> list[Float[np.ndarray, "V 2"]]:
    T = torch.from_numpy(T_world_ego)
    lines = []
    for index in (patch.kind == kind).nonzero()[:, 0].tolist():
        line = patch.vertices[index][patch.valid[index]].double()
        lines.append((line @ T[:3, :3].T + T[:3, 3])[:, :2].numpy())
    return lines
