"""An animated picture of a closed-loop drive: the front cameras, and the scene from above."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import find_camera, pinhole_cameras, read_camera
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.data.truth.affordances import read_stop_lines
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.observation import FRAME_DT_S
from foredrive.geometry.boxes import box_corners
from foredrive.scene import Boxes
from foredrive.scene.traffic_light import LightState
from foredrive.towns.map.town_map import load_town_map
from foredrive.view import palette
from foredrive.view.bev import EGO_OUTLINE_XY
from foredrive.view.video import write_video

SPEEDUP = 2.0
"""Speed of the video relative to real time."""
FRONT = ("pcam_l0", "pcam_f0", "pcam_r0", "ftcam_tele_f0")
SHOWN = 3
"""The cameras that are shown, side by side over the whole width, and how many of them at most."""
ABOVE_WH = (768, 288)
PX_PER_M, EGO_AT_X = 5.0, 0.3
"""Scale of the view from above, px per metre, and the position of the ego vehicle as a part of the width.
The ego vehicle faces right.
"""
MIN_RADIUS_PX = 3.5
"""Minimum radius of an actor, px; pedestrians would otherwise be too small to see."""
SCENARIO_CAPTION_S = 6.0
"""Time for which a caption shows a scenario after its start, s."""
ROAD, EDGE, ROUTE = "#2a323e", "#3b4656", "#2b6b47"
LIGHT_COLOURS = {LightState.RED: "#ff3b3b", LightState.YELLOW: "#ffc53d", LightState.GREEN: "#3ddc6b"}


def write_drive_video(path: Path, log: LogPath, drive: DriveRecord) -> None:
    """Write an animated WebP for browsers: one frame for each key frame, at twice real time.

    Args:
        log: log of the drive.
        drive: record of the drive.
    """
    opened = Log(log)
    frames = (draw_drive_frame(opened, index, drive) for index in range(len(opened)))
    write_video(path, frames, FRAME_DT_S / SPEEDUP)


def draw_drive_frame(log: Log, index: int, drive: DriveRecord) -> Image.Image:
    """Draw one key frame of a drive."""
    above = draw_from_above(
        drive.town,
        np.array(drive.route_xy),
        log.T_world_ego[index],
        read_boxes(log, index),
        read_stop_lines(log, index),
    )
    _caption(ImageDraw.Draw(above), log, index, drive)
    cameras = pinhole_cameras(log)
    front = [camera for name in FRONT if (camera := find_camera(cameras, name)) is not None][:SHOWN]
    if not front:
        return above
    # All cameras of a row have the shape of the first
    width = ABOVE_WH[0] // len(front)
    height = round(width * front[0].height / front[0].width)
    frame = Image.new("RGB", (ABOVE_WH[0], ABOVE_WH[1] + height), palette.GROUND)
    frame.paste(above, (0, height))
    for number, camera in enumerate(front):
        image = read_camera(log, index, camera, (height, width), with_image=True).image
        if image is not None:
            frame.paste(Image.fromarray(image.permute(1, 2, 0).numpy()), (number * width, 0))
    return frame


def draw_from_above(
    town: str | None,
    route_xy: Float[np.ndarray, "N 2"],
    T_world_ego: Float[np.ndarray, "4 4"],
    boxes: Boxes | None,
    lights: Sequence[tuple[LightState, Float[np.ndarray, "2 2"]]] = (),
) -> Image.Image:
    """Draw the scene around the ego vehicle from above; the ego faces right.

    Args:
        town: town whose lanes are drawn; None: there is no map.
        boxes: boxes of the other actors, in the ego frame.
        lights: states of lights, and the ends of their stop lines in the world.
    """
    twice = 2  # Drawn at twice the size and shrunk, because PIL does not smooth the edges of polygons
    image = Image.new("RGB", (twice * ABOVE_WH[0], twice * ABOVE_WH[1]), palette.GROUND)
    pen = ImageDraw.Draw(image)
    T_ego_world = np.linalg.inv(T_world_ego)

    def pixels(xy_ego: Float[np.ndarray, "N 2"]) -> list[tuple[float, float]]:
        # Forward is to the right and left is up; image rows count downwards
        x = twice * (EGO_AT_X * ABOVE_WH[0] + PX_PER_M * xy_ego[:, 0])
        y = twice * (0.5 * ABOVE_WH[1] - PX_PER_M * xy_ego[:, 1])
        return list(zip(x.tolist(), y.tolist(), strict=True))

    def from_world(xy: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        return xy @ T_ego_world[:2, :2].T + T_ego_world[:2, 3]

    for outline in [] if town is None else _lane_outlines(town):
        if np.abs(outline - T_world_ego[:2, 3]).max(axis=1).min() < ABOVE_WH[0] / PX_PER_M:
            pen.polygon(pixels(from_world(outline)), fill=ROAD, outline=EDGE, width=twice)
    pen.line(pixels(from_world(route_xy)), fill=ROUTE, width=twice * 4, joint="curve")
    for state, ends in lights:
        pen.line(pixels(from_world(ends)), fill=LIGHT_COLOURS[state], width=twice * 3)
    if boxes is not None:
        boxes = boxes[boxes.valid]
        corners = box_corners(boxes.centre, boxes.size_lwh, boxes.yaw)[:, :4, :2]
        for outline, category in zip(corners.double().numpy(), boxes.category.tolist(), strict=True):
            pen.polygon(pixels(outline), fill=palette.box_colour(category))
            middle = np.mean(pixels(outline), axis=0)
            pen.circle((middle[0], middle[1]), twice * MIN_RADIUS_PX, fill=palette.box_colour(category))
    pen.polygon(pixels(EGO_OUTLINE_XY), fill=palette.EGO)
    return image.resize(ABOVE_WH, Image.Resampling.BOX)


def _caption(pen: ImageDraw.ImageDraw, log: Log, index: int, drive: DriveRecord) -> None:
    t_s = float(log.t_us[index] - log.t_us[0]) * 1e-6
    font = ImageFont.load_default(size=16)
    pen.text((10, 8), f"{t_s:.1f} s   {log.speed_mps[index]:.1f} m/s", fill=palette.INK, font=font)
    begun = [event for event in drive.scenario_events if 0.0 <= t_s - event.t_s < SCENARIO_CAPTION_S]
    for event in begun[-1:]:
        text = event.what.replace("_", " ")
        pen.text((ABOVE_WH[0] - 10, 8), text, fill=palette.SCENARIO, font=font, anchor="ra")
    wrong = [infraction for infraction in drive.score.infractions if infraction.t_s <= t_s + 1e-6]
    for line, infraction in enumerate(wrong[-4:]):
        kind = infraction.kind.replace("_", " ")
        text = f"{infraction.t_s:.1f} s  {kind} {infraction.what}"
        pen.text((10, 34 + 22 * line), text, fill=palette.PLAN, font=font)


@lru_cache(maxsize=2)
def _lane_outlines(town: str) -> list[Float[np.ndarray, "N 2"]]:
    return [
        np.concatenate([lane.left_boundary_xyz[:, :2], lane.right_boundary_xyz[::-1, :2]])
        for lane in load_town_map(town).lanes
    ]
