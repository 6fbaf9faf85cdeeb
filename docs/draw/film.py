"""Makes docs/film.webp, the moving picture of the README.

    foredrive reconstruct data/logs/pandaset_train/002 --cameras pcam_f0 --out runs/002
    python docs/draw/film.py runs/002

Above: PandaSet's log 002 (CC BY 4.0, Hesai and Scale AI) as it was recorded, and the reconstruction without a
car, seen from 2 m to the left. Below: the driver of the package on a route by sight.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from foredrive.data import LogPath
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import find_camera, pinhole_cameras, read_camera
from foredrive.data.logs import Log
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.observation import FRAME_DT_S
from foredrive.geometry.boxes import box_corners
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3
from foredrive.methods.reconstruction.edits import Remove, ShiftEgo
from foredrive.runs.drive.agent_inputs import rig_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.reconstruction.reconstruction_run import edited_scene, open_reconstruction, open_run_log
from foredrive.runs.reconstruction.render import plan_frames, render_frame
from foredrive.runs.shipped import run_folder
from foredrive.view import palette
from foredrive.view.drive_video import ABOVE_WH, draw_drive_frame
from foredrive.view.image_drawing import resize, write_text
from foredrive.view.video import write_video

ROUTE, CAMERA = "12", "pcam_f0"
REMOVED, LEFT_M = 40, 2.0
STEP_S, SPEEDUP = 1 / 6, 3.0
GAP, TITLE = 6, 24
LEFT, RIGHT = "a recorded log", "rebuilt: without the marked car, from 2 m to the left"
BELOW = "driving by sight: two cameras, route and speed; at three times real time"


def street(run: Path) -> list[Image.Image]:
    """Return the log and its edited reconstruction side by side, in real time."""
    opened = open_reconstruction(run)
    recorded = Log(open_run_log(run)[1])
    camera = find_camera(pinhole_cameras(recorded), CAMERA)
    assert camera is not None
    edited = edited_scene(opened.scene, [Remove(REMOVED), ShiftEgo((0.0, LEFT_M, 0.0))])
    plan = plan_frames(opened.vehicle, [CAMERA], rate_hz=1 / STEP_S)
    width = (ABOVE_WH[0] - GAP) // 2
    frames = []
    for number, t_s in enumerate(plan.t_s):
        rebuilt = render_frame(opened.scene, opened.vehicle, edited, plan, number).images[0]
        height = round(width * rebuilt.shape[-2] / rebuilt.shape[-1])
        frame = int(np.abs(recorded.t_us - recorded.t_us[0] - 1e6 * t_s).argmin())
        seen = read_camera(recorded, frame, camera, (height, width), with_image=True).image
        assert seen is not None
        picture = Image.fromarray(seen.permute(1, 2, 0).numpy())
        mark(ImageDraw.Draw(picture), recorded, frame, (height, width))
        canvas = Image.new("RGB", (ABOVE_WH[0], height), palette.GROUND)
        canvas.paste(picture, (0, 0))
        right = resize(rebuilt.permute(1, 2, 0).numpy(), (height, width))
        canvas.paste(Image.fromarray(right), (width + GAP, 0))
        frames.append(canvas)
    return frames


def mark(pen: ImageDraw.ImageDraw, recorded: Log, frame: int, size_hw: tuple[int, int]) -> None:
    """Draw a rectangle around the car that the reconstruction leaves out."""
    boxes, metadata = read_boxes(recorded, frame), find_camera(pinhole_cameras(recorded), CAMERA)
    assert metadata is not None
    camera = read_camera(recorded, frame, metadata, size_hw, with_image=False)
    for car in [] if boxes is None else torch.nonzero(boxes.track_id == REMOVED)[:, 0].tolist():
        corners = box_corners(boxes.centre[car], boxes.size_lwh[car], boxes.yaw[car])
        T_cam_ego = inverse_se3(camera.T_ego_cam)
        uv, _, visible = project(
            corners @ T_cam_ego[:3, :3].T + T_cam_ego[:3, 3], camera.K, camera.dist, size_hw
        )
        if bool(visible.any()):
            pen.rectangle([*uv.amin(0).tolist(), *uv.amax(0).tolist()], outline=palette.PLAN, width=2)


def drive(folder: Path) -> tuple[Log, DriveRecord]:
    """Drive the route, and return the log and the record."""
    agent = str(run_folder(Path("embedded"), folder).absolute())
    source = TownRoutes("town05-short", only=(ROUTE,), rig=rig_of(agent))
    (driven,) = drive_suite(DriveSuite(agent, source, lidar=False), folder / "drive").drives.values()
    return Log(LogPath(folder / "drive" / driven.log, folder / "drive" / "maps")), driven


def film(above: list[Image.Image], log: Log, driven: DriveRecord) -> Iterator[Image.Image]:
    """Yield the frames. The street begins again while the drive goes on."""
    held = round(FRAME_DT_S / SPEEDUP / STEP_S)
    for index in range(len(log)):
        below = draw_drive_frame(log, index, driven)
        for part in range(held):
            street_now = above[(index * held + part) % len(above)]
            top = TITLE + street_now.height
            canvas = Image.new("RGB", (ABOVE_WH[0], top + TITLE + below.height), palette.GROUND)
            pen = ImageDraw.Draw(canvas)
            write_text(pen, (4, 4), LEFT, 14, palette.INK)
            write_text(pen, (ABOVE_WH[0] // 2 + 4, 4), RIGHT, 14, palette.INK)
            canvas.paste(street_now, (0, TITLE))
            write_text(pen, (4, top + 4), BELOW, 14, palette.INK)
            canvas.paste(below, (0, top + TITLE))
            yield canvas


def main() -> None:
    """Render the street, drive, and write the film."""
    above = street(Path(sys.argv[1]))
    with tempfile.TemporaryDirectory() as folder:
        frames = film(above, *drive(Path(folder)))
        write_video(Path(__file__).parents[1] / "film.webp", frames, STEP_S)


if __name__ == "__main__":
    main()
