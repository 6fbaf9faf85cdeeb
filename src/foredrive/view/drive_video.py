"""An animated picture of a drive: front cameras and the scene from above, with the plan and what is seen."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from PIL import Image, ImageDraw, ImageFont

from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import find_camera, pinhole_cameras, read_camera
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.data.truth.affordances import read_stop_lines
from foredrive.driving.drive_record import DriveRecord, PlanRecord
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.speed_rule import FRONT_M
from foredrive.geometry.boxes import box_corners
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import Boxes
from foredrive.scene.affordances import CELL_M
from foredrive.scene.traffic_light import LightState
from foredrive.towns.map.loading import load_town_map
from foredrive.view import palette
from foredrive.view.bev import EGO_OUTLINE_XY
from foredrive.view.image_drawing import Camera, draw_boxes_on_image, draw_path_on_image
from foredrive.view.video import write_video

SPEEDUP = 2.0
"""Speed of the video relative to real time."""
FRONT = ("pcam_l0", "pcam_f0", "pcam_r0")
AHEAD, TELE = "pcam_f0", "ftcam_tele_f0"
"""The cameras that are shown: three side by side over the whole width, or the one ahead, large, with the
telephoto lens beside it."""
ABOVE_WH = (768, 288)
PX_PER_M, EGO_AT_X = 5.0, 0.3
"""Scale of the view from above, px per metre, and the position of the ego vehicle as a part of the width.
The ego vehicle faces right.
"""
MIN_RADIUS_PX = 3.5
"""Minimum radius of an actor, px; pedestrians would otherwise be too small to see."""
PROBABLE = 0.5
"""Probability from which a cell of the path is shown as occupied."""
SCENARIO_CAPTION_S = 6.0
"""Time for which a caption shows a scenario after its start, s."""
ROAD, EDGE, ROUTE = "#2a323e", "#3b4656", "#2b6b47"
SEEN = "#ff9f1c"
LEGEND = ("plan", palette.PLAN), ("sees: road user on the route", SEEN), ("sees: light (ring)", palette.FAINT)
LIGHT_COLOURS = {LightState.RED: "#ff3b3b", LightState.YELLOW: "#ffc53d", LightState.GREEN: "#3ddc6b"}


Lanes = Sequence[Float64[np.ndarray, "_ 2"]]
"""Outlines of lanes, world frame, m."""


def write_drive_video(path: Path, log: LogPath, drive: DriveRecord, lanes: Lanes = ()) -> None:
    """Write an animated WebP for browsers: one frame for each key frame, at twice real time.

    Args:
        log: log of the drive.
        drive: record of the drive.
        lanes: the lanes to draw; those of a town are known.
    """
    opened = Log(log)
    frames = (draw_drive_frame(opened, index, drive, lanes) for index in range(len(opened)))
    write_video(path, frames, FRAME_DT_S / SPEEDUP)


def draw_drive_frame(log: Log, index: int, drive: DriveRecord, lanes: Lanes = ()) -> Image.Image:
    """Draw one key frame of a drive."""
    plan, boxes = _plan_at(drive, _time_s(log, index)), read_boxes(log, index)
    track = None if drive.threat is None else drive.threat.track
    sent = None if track is None or boxes is None else boxes[boxes.track_id == track]
    above = draw_from_above(
        lanes if drive.town is None else _lane_outlines(drive.town),
        np.array(drive.route_xy),
        log.T_world_ego[index],
        boxes,
        read_stop_lines(log, index),
        plan,
        sent,
    )
    pen = ImageDraw.Draw(above)
    if plan is not None:
        _legend(pen, tells=bool(plan.occupied))
    places, cameras = _places(log), pinhole_cameras(log)
    if not places:
        _caption(pen, 0, 0, log, index, drive)
        return above
    top = max(place.height for place in places.values())
    frame = Image.new("RGB", (ABOVE_WH[0], top + ABOVE_WH[1]), palette.GROUND)
    frame.paste(above, (0, top))
    for name, place in places.items():
        camera, size_hw = find_camera(cameras, name), (place.height, place.width)
        assert camera is not None
        view = read_camera(log, index, camera, size_hw, with_image=True)
        if view.image is None:
            continue
        image = view.image.permute(1, 2, 0).numpy()
        lens = Camera(view.K, view.T_ego_cam, view.dist, size_hw)
        if sent is not None:
            image = draw_boxes_on_image(image, sent, lens, colour=palette.SCENARIO)
        if plan is not None:
            path_ego = _in_ego(np.array(plan.xy), log.T_world_ego[index])
            on_ground = torch.from_numpy(np.column_stack([path_ego, np.zeros(len(path_ego))])).float()
            image = draw_path_on_image(image, on_ground, lens, palette.PLAN)
        frame.paste(Image.fromarray(image), (place.left, 0))
    # Below the smallest camera if that leaves a panel, otherwise on the map
    last = list(places.values())[-1]
    corner = (last.left, last.height) if last.height < top else (0, top)
    _caption(ImageDraw.Draw(frame), *corner, log, index, drive)
    return frame


class Place(NamedTuple):
    """The place of a camera's image in the film, px."""

    left: int
    width: int
    height: int


def _places(log: Log) -> dict[str, Place]:
    """Return the names of the cameras to show, with their places."""
    cameras = pinhole_cameras(log)
    shown = {name: camera for name in (*FRONT, TELE) if (camera := find_camera(cameras, name)) is not None}
    if AHEAD in shown and TELE in shown:
        large = 2 * ABOVE_WH[0] // 3
        columns = {AHEAD: (0, large), TELE: (large, ABOVE_WH[0] - large)}
    else:
        row = [name for name in FRONT if name in shown]
        width = ABOVE_WH[0] // max(len(row), 1)
        columns = {name: (number * width, width) for number, name in enumerate(row)}
    return {
        name: Place(left, width, round(width * shown[name].height / shown[name].width))
        for name, (left, width) in columns.items()
    }


def _plan_at(drive: DriveRecord, t_s: float) -> PlanRecord | None:
    """Return the last plan that was made until a time."""
    made = [plan for plan in drive.plans if plan.t_s <= t_s + 1e-3]
    return made[-1] if made else None


def _time_s(log: Log, index: int) -> float:
    return float(log.t_us[index] - log.t_us[0]) * 1e-6


def _in_ego(
    xy: Float64[np.ndarray, "N 2"], T_world_ego: Float[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "N 2"]:
    T_ego_world = np.linalg.inv(T_world_ego)
    return xy @ T_ego_world[:2, :2].T + T_ego_world[:2, 3]


def draw_from_above(
    lanes: Lanes,
    route_xy: Float[np.ndarray, "N 2"],
    T_world_ego: Float[np.ndarray, "4 4"],
    boxes: Boxes | None,
    lights: Sequence[tuple[LightState, Float[np.ndarray, "2 2"]]] = (),
    plan: PlanRecord | None = None,
    sent: Boxes | None = None,
) -> Image.Image:
    """Draw the scene around the ego vehicle from above; the ego faces right.

    Args:
        lanes: the lanes of the map.
        boxes: boxes of the other actors, in the ego frame.
        lights: states of lights, and the ends of their stop lines in the world.
        plan: the plan of the frame, and what the agent saw of its route.
        sent: boxes of a vehicle that was sent into the way.
    """
    twice = 2  # Drawn at twice the size and shrunk, because PIL does not smooth the edges of polygons
    image = Image.new("RGB", (twice * ABOVE_WH[0], twice * ABOVE_WH[1]), palette.GROUND)
    pen = ImageDraw.Draw(image)

    def pixels(xy_ego: Float[np.ndarray, "N 2"]) -> list[tuple[float, float]]:
        # Forward is to the right and left is up; image rows count downwards
        x = twice * (EGO_AT_X * ABOVE_WH[0] + PX_PER_M * xy_ego[:, 0])
        y = twice * (0.5 * ABOVE_WH[1] - PX_PER_M * xy_ego[:, 1])
        return list(zip(x.tolist(), y.tolist(), strict=True))

    route_ego = _in_ego(route_xy, T_world_ego)
    for outline in lanes:
        if np.abs(outline - T_world_ego[:2, 3]).max(axis=1).min() < ABOVE_WH[0] / PX_PER_M:
            pen.polygon(pixels(_in_ego(outline, T_world_ego)), fill=ROAD, outline=EDGE, width=twice)
    pen.line(pixels(route_ego), fill=ROUTE, width=twice * 4, joint="curve")
    for piece in [] if plan is None else _occupied(route_ego, plan):
        pen.line(pixels(piece), fill=SEEN, width=twice * 9)
    for state, ends in lights:
        pen.line(pixels(_in_ego(ends, T_world_ego)), fill=LIGHT_COLOURS[state], width=twice * 3)
    for shown, colour in ((boxes, None), (sent, palette.SCENARIO)):
        if shown is None:
            continue
        shown = shown[shown.valid]
        corners = box_corners(shown.centre, shown.size_lwh, shown.yaw)[:, :4, :2]
        for outline, category in zip(corners.double().numpy(), shown.category.tolist(), strict=True):
            fill = colour or palette.box_colour(category)
            pen.polygon(pixels(outline), fill=fill)
            middle = np.mean(pixels(outline), axis=0)
            pen.circle((middle[0], middle[1]), twice * MIN_RADIUS_PX, fill=fill)
    if plan is not None:
        points = pixels(_in_ego(np.array(plan.xy), T_world_ego))
        pen.line(points, fill=palette.PLAN, width=twice * 2, joint="curve")
        for point in points[1:]:
            pen.circle(point, twice * 2.5, fill=palette.PLAN)
        if plan.light is not None and plan.light in LIGHT_COLOURS:
            (place,) = pixels(_ahead(route_ego, np.array([plan.light_m])))
            pen.circle(place, twice * 8, outline=LIGHT_COLOURS[plan.light], width=twice * 2)
    pen.polygon(pixels(EGO_OUTLINE_XY), fill=palette.EGO)
    return image.resize(ABOVE_WH, Image.Resampling.BOX)


def _ahead(
    route_ego: Float64[np.ndarray, "N 2"], ahead_m: Float64[np.ndarray, "n"]
) -> Float64[np.ndarray, "n 2"]:
    """Return points of the route at distances ahead of the front bumper."""
    arc_m = arc_lengths(route_ego)
    fine_m = np.arange(0.0, arc_m[-1], 0.5)
    # The part of the route beside the vehicle, which is at the origin
    beside_m = fine_m[np.hypot(*points_at(route_ego, arc_m, fine_m).T).argmin()]
    return points_at(route_ego, arc_m, beside_m + FRONT_M + ahead_m)


def _occupied(route_ego: Float64[np.ndarray, "N 2"], plan: PlanRecord) -> list[Float64[np.ndarray, "2 2"]]:
    """Return the cells of the route where the agent sees somebody, each as its two ends."""
    cells = np.flatnonzero(np.array(plan.occupied) >= PROBABLE)
    return [_ahead(route_ego, CELL_M * np.array([cell, cell + 1.0])) for cell in cells]


def _legend(pen: ImageDraw.ImageDraw, *, tells: bool) -> None:
    font, x = ImageFont.load_default(size=13), 10.0
    for text, colour in LEGEND if tells else LEGEND[:1]:
        pen.text((x, ABOVE_WH[1] - 22), text, fill=colour, font=font)
        x += pen.textlength(text, font=font) + 18


def _caption(pen: ImageDraw.ImageDraw, left: int, top: int, log: Log, index: int, drive: DriveRecord) -> None:
    """Write time, speed, the scenario that has begun and the last infractions below a corner."""
    t_s, font = _time_s(log, index), ImageFont.load_default(size=16)
    lines = [(f"{t_s:.1f} s   {log.speed_mps[index]:.1f} m/s", palette.INK)]
    if drive.threat is not None:
        lines.append((f"sent into the way: {drive.threat.kind}", palette.SCENARIO))
    begun = [event for event in drive.scenario_events if 0.0 <= t_s - event.t_s < SCENARIO_CAPTION_S]
    lines += [(event.what.replace("_", " "), palette.SCENARIO) for event in begun[-1:]]
    wrong = [infraction for infraction in drive.score.infractions if infraction.t_s <= t_s + 1e-6]
    lines += [
        (f"{infraction.t_s:.1f} s  {infraction.kind.replace('_', ' ')} {infraction.what}", palette.PLAN)
        for infraction in wrong[-2:]
    ]
    for number, (text, colour) in enumerate(lines):
        pen.text((left + 10, top + 8 + 22 * number), text, fill=colour, font=font)


@lru_cache(maxsize=2)
def _lane_outlines(town: str) -> list[Float[np.ndarray, "N 2"]]:
    return [
        np.concatenate([lane.left_boundary_xyz[:, :2], lane.right_boundary_xyz[::-1, :2]])
        for lane in load_town_map(town).lanes
    ]
