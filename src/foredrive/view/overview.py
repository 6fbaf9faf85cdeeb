"""One wide picture of Foredrive: cameras and lidar as input, occupancy and a plan as output."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from matplotlib.figure import Figure
from PIL import Image, ImageDraw
from torch import Tensor

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.runs import ExamplePrediction
from foredrive.scene import Clip, Trajectory, VoxelSpec
from foredrive.view import palette
from foredrive.view.bev import path_points
from foredrive.view.example_panel import example_title
from foredrive.view.log_sheet import camera_picture, camera_rows
from foredrive.view.voxel_drawing import Viewpoint, draw_voxels

DPI = 100
CAMERA_WIDTH_PX, VOXELS_WIDTH_PX = 384, 760
GAP_PX, CAPTION_PX = 8, 46
SUPERSAMPLING = 2
EGO_LOWER_M, EGO_UPPER_M = (-1.0, -0.92, 0.1), (3.1, 0.92, 1.55)
PATH_WIDTH_PX, DOT_PX = 4, 5
OUTPUT_CAPTION = "Output: predicted occupancy and plan (red; driven path: green)"


@dataclass(frozen=True)
class Overview:
    """Input of a model at one time, with its occupancy and plan, all without leading dimensions."""

    title: str
    clip: Clip
    occupied: Bool[Tensor, "Z Y X"]
    plan: Trajectory
    spec: VoxelSpec

    @classmethod
    def of(cls, shown: ExamplePrediction) -> "Overview":
        """Return the overview of an example."""
        example = shown.example
        return cls(
            example_title(example), example.clip, shown.occupied[0], shown.plan, example.occupancy.spec
        )


def write_overview(path: Path, shown: Overview) -> None:
    """Write the picture as a PNG, about 1,900 px wide for six cameras.

    Raises:
        InputError: there are no camera images.
    """
    clip = shown.clip
    rows = camera_rows(clip.rig[clip.now])
    if not rows or not bool(clip.image_valid[clip.now].any()):
        raise InputError(f"{shown.title}: no camera images to make a picture of")
    cell_h = round(CAMERA_WIDTH_PX * clip.rig.size_hw[0] / clip.rig.size_hw[1])
    columns = max(len(row) for row in rows)
    cameras_w = columns * (CAMERA_WIDTH_PX + GAP_PX) - GAP_PX
    body_h = len(rows) * (cell_h + GAP_PX) - GAP_PX
    canvas = Image.new(
        "RGB",
        (cameras_w + VOXELS_WIDTH_PX + 3 * GAP_PX, body_h + CAPTION_PX + GAP_PX),
        palette.GROUND,
    )
    for row, cameras in enumerate(rows):
        for column, camera in enumerate(cameras):
            picture = camera_picture(clip, camera, (cell_h, CAMERA_WIDTH_PX), with_boxes=False)
            corner_px = (GAP_PX + column * (CAMERA_WIDTH_PX + GAP_PX), CAPTION_PX + row * (cell_h + GAP_PX))
            canvas.paste(Image.fromarray(picture), corner_px)
    voxels = occupancy_with_paths(shown, (body_h, VOXELS_WIDTH_PX))
    canvas.paste(Image.fromarray(voxels), (2 * GAP_PX + cameras_w, CAPTION_PX))
    seen = "camera images, with lidar returns" if bool(clip.sweep_valid[clip.now]) else "camera images"
    captions = {GAP_PX: f"Input: {seen}", 2 * GAP_PX + cameras_w: OUTPUT_CAPTION}
    with atomic_path(path) as scratch:
        _captioned(np.asarray(canvas), captions).savefig(scratch, dpi=DPI, format="png")


def occupancy_with_paths(shown: Overview, size_hw: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw predicted occupancy now in perspective, with the vehicle, the driven future and the plan."""
    viewpoint = Viewpoint.behind(shown.spec, size_hw)
    picture = draw_voxels(shown.occupied, shown.spec, size_hw, viewpoint)
    large_hw = (size_hw[0] * SUPERSAMPLING, size_hw[1] * SUPERSAMPLING)
    canvas = Image.fromarray(picture).resize(large_hw[::-1], Image.Resampling.NEAREST)
    draw = ImageDraw.Draw(canvas)
    _draw_path(draw, viewpoint, large_hw, shown.clip.future, palette.EXPERT)
    _draw_path(draw, viewpoint, large_hw, shown.plan, palette.PLAN)
    _draw_ego(draw, viewpoint, large_hw)
    return np.asarray(canvas.resize(size_hw[::-1], Image.Resampling.BOX))


def _draw_path(
    draw: ImageDraw.ImageDraw, viewpoint: Viewpoint, size_hw: tuple[int, int], path: Trajectory, colour: str
) -> None:
    points = [tuple(p) for p in viewpoint.project(path_points(path).numpy(), size_hw).tolist()]
    draw.line(points, fill=colour, width=PATH_WIDTH_PX * SUPERSAMPLING, joint="curve")
    for x, y in points[1:]:
        draw.circle((x, y), DOT_PX * SUPERSAMPLING, fill=colour, outline=palette.GROUND, width=2)


def _draw_ego(draw: ImageDraw.ImageDraw, viewpoint: Viewpoint, size_hw: tuple[int, int]) -> None:
    """Draw the vehicle as a box: the rear, right side and top, which are visible from the viewpoint."""
    (x0, y0, z0), (x1, y1, z1) = EGO_LOWER_M, EGO_UPPER_M
    # Each face with its brightness; the top is drawn last, over the other two
    faces = (
        (0.62, [(x0, y0, z0), (x0, y1, z0), (x0, y1, z1), (x0, y0, z1)]),
        (0.78, [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)]),
        (1.0, [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)]),
    )
    for light, face in faces:
        corners = viewpoint.project(np.array(face), size_hw)
        fill = tuple(round(light * c) for c in palette.rgb255(palette.EGO))
        draw.polygon([tuple(p) for p in corners.tolist()], fill=fill, outline=palette.GROUND)


def _captioned(picture: UInt8[np.ndarray, "H W 3"], captions: dict[int, str]) -> Figure:
    """Make a figure of the picture's size, with texts at columns of its upper margin."""
    height, width = picture.shape[:2]
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    figure.figimage(picture)
    for column, text in captions.items():
        figure.text(
            column / width, 1 - CAPTION_PX / 2 / height, text, color=palette.INK, fontsize=13, va="center"
        )
    return figure
