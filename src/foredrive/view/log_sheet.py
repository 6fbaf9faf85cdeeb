"""One time of a log on one page: every camera with points and boxes, and the view from above."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from torch import Tensor

from foredrive.scene import CameraRig, Clip
from foredrive.view import palette
from foredrive.view.bev import draw_bev, legend_handles
from foredrive.view.image_drawing import Camera, draw_boxes_on_image, draw_points_on_image, resize
from foredrive.view.log_frames import CAMERA_WIDTH_PX
from foredrive.view.sheet import Sheet

GAP_PX, HEAD_PX, AXIS_PX, LEGEND_PX = 10, 64, 60, 230
MIN_BEV_PX = 640


def write_log_sheet(path: Path, clip: Clip, title: str, reach_m: float = 50.0) -> None:
    """Write the page as a PNG.

    Args:
        path: path of the picture; it is written completely or not at all.
        clip: without leading dimensions; its frame at t = 0 is drawn.
        title: name of the log, and the time.
        reach_m: distance that the view from above shows in each direction.
    """
    rig = clip.rig[clip.now]
    rows = camera_rows(rig)
    columns = max((len(row) for row in rows), default=0)
    cell_h = round(CAMERA_WIDTH_PX * rig.size_hw[0] / rig.size_hw[1])
    left_w = columns * (CAMERA_WIDTH_PX + GAP_PX)
    body_h = max(len(rows) * (cell_h + GAP_PX) - GAP_PX, MIN_BEV_PX)
    bev_left = GAP_PX + left_w + AXIS_PX
    width, height = bev_left + body_h + LEGEND_PX, HEAD_PX + body_h + AXIS_PX
    sheet = Sheet(width, height)
    for row, cameras in enumerate(rows):
        inset = (columns - len(cameras)) * (CAMERA_WIDTH_PX + GAP_PX) // 2
        for column, camera in enumerate(cameras):
            ax = sheet.place(
                GAP_PX + inset + column * (CAMERA_WIDTH_PX + GAP_PX),
                HEAD_PX + row * (cell_h + GAP_PX),
                CAMERA_WIDTH_PX,
                cell_h,
            )
            _show_camera(ax, clip, camera, (cell_h, CAMERA_WIDTH_PX))
    draw_bev(sheet.place(bev_left, HEAD_PX, body_h, body_h), clip, reach_m)
    sheet.head(2 * GAP_PX, HEAD_PX, title, 17.0)
    sheet.figure.legend(
        handles=legend_handles(clip),
        loc="upper left",
        bbox_to_anchor=((bev_left + body_h + GAP_PX) / width, 1 - HEAD_PX / height),
        borderaxespad=0,
        frameon=False,
        labelcolor=palette.INK,
        fontsize=11,
        handlelength=1.6,
    )
    if bool(clip.sweep_valid[clip.now]):
        bar_w = LEGEND_PX - 5 * GAP_PX
        _range_bar(sheet.place(bev_left + body_h + 2 * GAP_PX, HEAD_PX + body_h - 24, bar_w, 12))
    sheet.save(path)


def camera_rows(rig: CameraRig) -> list[list[int]]:
    """Return rows of camera indices in their order around the car: forward cameras above backward ones.

    In both rows the cameras on the left of the car are on the left.
    """
    forward = rig.T_ego_cam[..., :2, 2]  # The optical axis seen from above
    azimuth = torch.atan2(forward[:, 1], forward[:, 0])
    ahead_first = azimuth.abs().argsort(stable=True).tolist()
    # Up to three cameras fit into one row
    front = (len(ahead_first) + 1) // 2 if len(ahead_first) > 3 else len(ahead_first)
    rows = [ahead_first[:front], ahead_first[front:]]
    return [sorted(row, key=lambda c: -_leftness(float(azimuth[c]))) for row in rows if row]


def _leftness(azimuth: float) -> float:
    """Return a number that is larger the farther left of the car's axis a camera looks."""
    return float(np.sin(azimuth)) if abs(azimuth) > 1e-6 else 0.0


def camera_picture(
    clip: Clip, index: int, size_hw: tuple[int, int], with_boxes: bool = True
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw one camera's image at now with lidar and boxes; an empty panel if there is no image."""
    now = clip.now
    if bool(clip.image_valid[now, index]):
        image = resize(clip.images[now, index].permute(1, 2, 0).numpy(), size_hw)
    else:
        image = np.full((*size_hw, 3), palette.rgb255(palette.PANEL), dtype=np.uint8)
    camera = Camera.of(clip.rig[now], index)
    if torch.equal(camera.K, torch.eye(3)):  # Padding for a camera that the log does not have
        return image
    camera = camera.resized(size_hw)
    if bool(clip.sweep_valid[now]):
        points, range_m = _returns(clip)
        image = draw_points_on_image(image, points, palette.range_colours(range_m), camera)
    if with_boxes and bool(clip.boxes_valid[now]):
        image = draw_boxes_on_image(image, clip.boxes[now], camera)
    return image


def _returns(clip: Clip) -> tuple[Float[Tensor, "N 3"], Float[np.ndarray, " N"]]:
    sweep = clip.sweeps[clip.now]
    returned = sweep.returned & sweep.valid
    return sweep.points_ego[returned], sweep.range_m[returned].numpy()


def _show_camera(ax: Axes, clip: Clip, index: int, size_hw: tuple[int, int]) -> None:
    ax.imshow(camera_picture(clip, index, size_hw), interpolation="none", aspect="auto")
    ax.set_axis_off()
    ax.text(
        0.015,
        0.965,
        clip.rig.names[index],
        transform=ax.transAxes,
        color=palette.INK,
        fontsize=11,
        va="top",
        bbox={"facecolor": palette.GROUND, "alpha": 0.65, "edgecolor": "none", "pad": 3},
    )
    if not bool(clip.image_valid[clip.now, index]):
        ax.text(
            0.5,
            0.5,
            "no image",
            transform=ax.transAxes,
            color=palette.FAINT,
            fontsize=16,
            ha="center",
            va="center",
        )


def _range_bar(ax: Axes) -> None:
    """Draw the colour scale of the lidar's range."""
    shown = LinearSegmentedColormap.from_list(
        "range", palette.RANGE_MAP(np.linspace(*palette.RANGE_SPAN, 64))
    )
    scale = ScalarMappable(LogNorm(palette.MIN_RANGE_M, palette.MAX_RANGE_M), shown)
    bar = ax.figure.colorbar(scale, cax=ax, orientation="horizontal")
    bar.set_ticks([3, 10, 30, 80], labels=["3", "10", "30", "80 m"])
    bar.ax.minorticks_off()
    bar.ax.tick_params(colors=palette.FAINT, labelsize=9, length=0)
    bar.outline.set_visible(False)
    ax.set_title("lidar range", color=palette.INK, fontsize=10, loc="left", pad=4)
