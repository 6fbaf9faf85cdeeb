"""A video of a drive through a reconstructed log: the cameras, and below them the lidar from above."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from rich.progress import track

from foredrive.files import make_folder
from foredrive.geometry.boxes import box_corners
from foredrive.methods.reconstruction.edits import (
    DriveStraight,
    Duplicate,
    Edit,
    Insert,
    Move,
    Remove,
    apply_edits,
)
from foredrive.runs.reconstruction.reconstruction_run import OpenedReconstruction, edited_scene
from foredrive.runs.reconstruction.render import RenderedFrame, RenderPlan, render_frame
from foredrive.scene import Boxes, CameraRig, LidarSweep
from foredrive.view import palette
from foredrive.view.bev import EGO_OUTLINE_XY
from foredrive.view.image_drawing import resize, write_text
from foredrive.view.log_sheet import camera_rows
from foredrive.view.video import check_video, write_video

Colour = Literal["intensity", "height"]
ONE_CAMERA_PX, CAMERA_PX = 480, 320
"""Width of a camera's picture, px: alone in its row, and beside others."""
GAP_PX, TITLE_PX = 8, 26
ABOVE_HW = (0.5, 0.35)
"""Height of the view from above, and the x position of the vehicle, both in widths of the view. The ego faces
right.
"""
ABOVE_M = 100.0
"""Width of the view from above, m."""
LOW_M, HIGH_M = -0.5, 4.0
"""Ends of the colour scale of heights above the ground, m."""
MAX_NAMED_EDITS = 3
"""Maximum number of edits that a caption names."""


def write_reconstruction_video(
    path: Path, run: OpenedReconstruction, edits: list[Edit], plan: RenderPlan, colour: Colour
) -> None:
    """Write a video of a run in real time, beside the run after edits if there are any.

    Raises:
        InputError: the edits cannot be made, or the path is not that of a video.
    """
    check_video(path)
    takes = [("as it was", apply_edits(run.scene.graph, []))]
    if edits:
        takes.append((describe_edits(edits), edited_scene(run.scene, edits)))
    make_folder(path.parent)
    rig, chosen = run.vehicle.rig, list(plan.cameras)
    rig = dataclasses.replace(rig[chosen], names=tuple(rig.names[camera] for camera in chosen))
    frames = (
        draw_shots(
            [(name, render_frame(run.scene, run.vehicle, edited, plan, k)) for name, edited in takes],
            rig,
            run.folder.name,
            colour,
        )
        for k in track(range(len(plan.t_s)), description=f"filming {run.folder.name}")
    )
    write_video(path, frames, plan.step_s)


def draw_shots(
    shots: Sequence[tuple[str, RenderedFrame]], rig: CameraRig, name: str, colour: Colour
) -> Image.Image:
    """Draw a frame: shots of the same time side by side, each under its caption.

    Args:
        shots: captions and shots.
        rig: rig of the rendered cameras, [C].
        name: name of the log.
        colour: quantity that colours the lidar's points.
    """
    columns = [_column(shot, rig, colour) for _, shot in shots]
    width = sum(column.width for column in columns) + GAP_PX * (len(columns) + 1)
    canvas = Image.new("RGB", (width, columns[0].height + 2 * TITLE_PX + GAP_PX), palette.GROUND)
    pen = ImageDraw.Draw(canvas)
    write_text(pen, (GAP_PX, 5), f"{name}   {shots[0][1].t_s:.1f} s", 15, palette.INK)
    x = GAP_PX
    for (caption, _), column in zip(shots, columns, strict=True):
        write_text(pen, (x, TITLE_PX + 5), caption, 13, palette.FAINT)
        canvas.paste(column, (x, 2 * TITLE_PX))
        x += column.width + GAP_PX
    return canvas


def describe_edits(edits: Sequence[Edit]) -> str:
    """Describe edits."""
    words = [describe_edit(edit) for edit in edits[:MAX_NAMED_EDITS]]
    more = len(edits) - MAX_NAMED_EDITS
    return "edited: " + ", ".join([*words, f"and {more} more"] if more > 0 else words)


def describe_edit(edit: Edit) -> str:
    """Describe an edit."""
    if isinstance(edit, Remove):
        return f"without {edit.actor}"
    if isinstance(edit, Move):
        return f"{edit.actor} moved"
    if isinstance(edit, Duplicate | DriveStraight):
        return f"{edit.copy} like {edit.actor}"
    if isinstance(edit, Insert):
        return f"{edit.copy} inserted on the way of {edit.follows}"
    forward_m, left_m, _ = edit.offset_m
    aside = f"{abs(left_m):g} m to the {'left' if left_m > 0 else 'right'}" if left_m else ""
    ahead = f"{abs(forward_m):g} m {'ahead' if forward_m > 0 else 'back'}" if forward_m else ""
    return " ".join(part for part in (aside, ahead) if part) or "ego vehicle turned"


def _column(shot: RenderedFrame, rig: CameraRig, colour: Colour) -> Image.Image:
    rows = camera_rows(rig) if rig.names else []
    longest = max((len(row) for row in rows), default=1)
    each_px = ONE_CAMERA_PX if longest == 1 else CAMERA_PX
    width = longest * (each_px + GAP_PX) - GAP_PX
    height = each_px * rig.size_hw[0] // rig.size_hw[1]
    above = None if shot.sweep is None else _draw_from_above(shot.sweep, shot.boxes, width, colour)
    whole = len(rows) * (height + GAP_PX) + (0 if above is None else above.height)
    canvas = Image.new("RGB", (width, whole), palette.GROUND)
    for line, row in enumerate(rows):
        for place, camera in enumerate(row):
            picture = resize(shot.images[camera].permute(1, 2, 0).numpy(), (height, each_px))
            canvas.paste(Image.fromarray(picture), (place * (each_px + GAP_PX), line * (height + GAP_PX)))
    if above is not None:
        canvas.paste(above, (0, len(rows) * (height + GAP_PX)))
    return canvas


def _draw_from_above(sweep: LidarSweep, boxes: Boxes, width_px: int, colour: Colour) -> Image.Image:
    """Draw coloured returns, low ones first, and the outlines of the actors with their ids."""
    twice = 2  # Drawn at twice the size and shrunk, because PIL does not smooth the edges of lines
    height_px = round(ABOVE_HW[0] * width_px)
    scale = twice * width_px / ABOVE_M
    picture = np.full((twice * height_px, twice * width_px, 3), palette.rgb255(palette.GROUND), np.uint8)

    def pixels(xy_ego: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        return np.array([ABOVE_HW[1] * twice * width_px, twice * height_px / 2]) + scale * xy_ego * [1, -1]

    returned = sweep[sweep.returned & sweep.valid]
    points = returned.points_ego.numpy()
    # High returns are drawn last, over low ones
    order = points[:, 2].argsort(kind="stable")
    colours = sweep_colours(returned, colour)[order]
    u, v = pixels(points[order, :2]).astype(int).T
    # A return covers a square of two pixels, one pixel of the final picture
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = u + right, v + down
        inside = (x >= 0) & (x < picture.shape[1]) & (y >= 0) & (y < picture.shape[0])
        picture[y[inside], x[inside]] = colours[inside]
    image = Image.fromarray(picture)
    pen = ImageDraw.Draw(image)
    corners = box_corners(boxes.centre, boxes.size_lwh, boxes.yaw)[:, :4, :2].double().numpy()
    for outline, category in zip(corners, boxes.category.tolist(), strict=True):
        around = [tuple(corner) for corner in pixels(outline)]
        pen.polygon(around, outline=palette.box_colour(category), width=twice)
    pen.polygon([tuple(corner) for corner in pixels(EGO_OUTLINE_XY)], fill=palette.EGO)
    image = image.resize((width_px, height_px), Image.Resampling.BOX)
    pen = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=11)
    for outline, track_id in zip(corners, boxes.track_id.tolist(), strict=True):
        u_px, v_px = pixels(outline).mean(0) / twice
        if 0 < u_px < width_px and 0 < v_px < height_px:
            pen.text((u_px, v_px), str(track_id), fill=palette.INK, font=font, anchor="mm")
    return image


def sweep_colours(sweep: LidarSweep, colour: Colour) -> UInt8[np.ndarray, "N 3"]:
    """Return colours of the returns by height above the ground, or by intensity."""
    if colour == "height":
        share = (sweep.points_ego[:, 2].numpy() - LOW_M) / (HIGH_M - LOW_M)
        mapped = palette.HEIGHT_MAP(share.clip(0, 1))
    else:
        # The colour map runs from bright to dark
        faint, bright = palette.RANGE_SPAN[::-1]
        share = np.sqrt(sweep.intensity.numpy().clip(0, 1))  # The root spreads the many faint returns
        mapped = palette.RANGE_MAP(faint + (bright - faint) * share)
    return (mapped[:, :3] * 255).astype(np.uint8)
