"""A video of imagined futures beside the recorded future: from above and through the cameras."""

import datetime
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from foredrive.runs.evaluate.imagination import ImaginedFutures
from foredrive.tasks.occupancy.scores import ABOVE_GROUND_M
from foredrive.view import palette
from foredrive.view.example_panel import COMPARISON_KEY, with_ego
from foredrive.view.image_drawing import resize, write_text
from foredrive.view.log_sheet import camera_rows
from foredrive.view.video import write_video
from foredrive.view.voxel_drawing import draw_comparison

PANEL_PX, GAP_PX, TITLE_PX, HEAD_PX, KEY_PX = 320, 10, 26, 40, 34
COLUMNS = 3
HOLD = 2
"""Number of frames that show now; each later key frame is shown once."""


def write_imagination_video(path: Path, moments: Iterable[ImaginedFutures], frame_dt_s: float) -> int:
    """Write the futures from each time, one after another, in real time; return the number of frames."""
    frames = []
    for imagined in moments:
        shown = [draw_imagined(imagined, step, frame_dt_s) for step in range(imagined.futures.shape[1])]
        frames += [shown[0]] * HOLD + shown[1:]
    write_video(path, frames, frame_dt_s)
    return len(frames)


def draw_imagined(imagined: ImaginedFutures, step: int, frame_dt_s: float) -> Image.Image:
    """Draw the recorded and all imagined futures at one key frame: front cameras above, occupancy below.

    Args:
        step: index of the key frame; 0 is now.
    """
    rows = _camera_strips(imagined, step)
    label = imagined.example.occupancy
    frame = imagined.example.clip.now + step
    truth, valid = label.values[frame, 0] > 0.5, label.known[frame]
    panels = [("recorded", truth)]
    count = len(imagined.futures)
    panels += [
        (f"future {k + 1} of {count}" if count > 1 else "imagined", future[step])
        for k, future in enumerate(imagined.futures)
    ]
    # Rounded up
    lines = -(-len(panels) // COLUMNS)
    cell_h = TITLE_PX + PANEL_PX * truth.shape[2] // truth.shape[1] + GAP_PX
    strips_h = sum(TITLE_PX + strip.shape[0] + GAP_PX for _, strip in rows)
    width = COLUMNS * (PANEL_PX + GAP_PX) + GAP_PX
    canvas = Image.new("RGB", (width, HEAD_PX + strips_h + lines * cell_h + KEY_PX), palette.GROUND)
    pen, y = ImageDraw.Draw(canvas), HEAD_PX
    write_text(pen, (GAP_PX, 9), _title(imagined, step, frame_dt_s), 18, palette.INK)
    for title, strip in rows:
        write_text(pen, (GAP_PX, y + 5), title, 13, palette.FAINT)
        canvas.paste(Image.fromarray(strip), (GAP_PX, y + TITLE_PX))
        y += TITLE_PX + strip.shape[0] + GAP_PX
    for number, (title, occupied) in enumerate(panels):
        line, column = divmod(number, COLUMNS)
        corner_px = (GAP_PX + column * (PANEL_PX + GAP_PX), y + line * cell_h)
        columns = draw_comparison(occupied, truth, valid, label.spec, ABOVE_GROUND_M)
        picture = with_ego(columns, label.spec)
        size_hw = (PANEL_PX * picture.shape[0] // picture.shape[1], PANEL_PX)
        write_text(
            pen, (corner_px[0], corner_px[1] + 5), title, 13, palette.INK if number == 0 else palette.FAINT
        )
        canvas.paste(Image.fromarray(resize(picture, size_hw)), (corner_px[0], corner_px[1] + TITLE_PX))
    _draw_key(pen, canvas.height - KEY_PX + 6)
    return canvas


def _camera_strips(imagined: ImaginedFutures, step: int) -> list[tuple[str, UInt8[np.ndarray, "h w 3"]]]:
    """Draw the three cameras that point most straight ahead: recorded images, and rendered ones if any."""
    clip = imagined.example.clip
    frame = clip.now + step
    order = camera_rows(clip.rig[frame])
    ahead = order[0][:COLUMNS] if order else []
    shown = [camera for camera in ahead if bool(clip.image_valid[frame, camera])]
    if not shown:
        return []
    strips = [("recorded images", _strip(clip.images[frame, shown]))]
    if imagined.rendered is not None:
        rendered = (imagined.rendered[step, shown].clamp(0, 1) * 255).byte()
        strips.append(("rendered from the imagined volume", _strip(rendered)))
    return strips


def _strip(images: Tensor) -> UInt8[np.ndarray, "h w 3"]:
    """Put images [C 3 h w] side by side, each with the width of a panel."""
    height = PANEL_PX * images.shape[2] // images.shape[3]
    gap = np.full((height, GAP_PX, 3), palette.rgb255(palette.GROUND), dtype=np.uint8)
    parts = []
    for image in images:
        parts += [resize(image.permute(1, 2, 0).numpy(), (height, PANEL_PX)), gap]
    return np.concatenate(parts[:-1], axis=1)


def _title(imagined: ImaginedFutures, step: int, frame_dt_s: float) -> str:
    log, _, t_us = imagined.example.key[0].rpartition("@")
    taken = datetime.datetime.fromtimestamp(int(t_us) * 1e-6, datetime.UTC)
    when = f"+{step * frame_dt_s:.1f} s" if step else "now"
    return f"{log}  {taken:%H:%M:%S}   {when}"


def _draw_key(pen: ImageDraw.ImageDraw, y: int) -> None:
    x = GAP_PX
    font = ImageFont.load_default(size=13)
    for colour, name in COMPARISON_KEY:
        pen.rectangle((x, y + 2, x + 14, y + 16), fill=colour, outline=palette.GRID)
        pen.text((x + 20, y), name, fill=palette.FAINT, font=font)
        x += 20 + round(pen.textlength(name, font=font)) + 24
