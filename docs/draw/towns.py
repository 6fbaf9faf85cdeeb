"""Draws the pictures of docs/towns.md: `python docs/draw/towns.py`. Takes some minutes."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import LidarSweep
from foredrive.scene.conditions import CONDITIONS, Conditions
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.names import TOWNS
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic.expert import ExpertDrive
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.world import SensorFrame, World

DOCS = Path(__file__).parents[1]
TILES = ("Town11_Tile_-7_42", "Town12_Tile_4_-15", "Town13_Tile_14_-16")
SIZE_HW = (216, 384)
SEED = 4
GAP = 6
REACH_M = 50.0
BRIGHTER = 2.55
"""White is what a white matt surface returns; signs and plates return more."""


def see(town: str, all_conditions: Mapping[str, Conditions], at_s: float = 6.0) -> dict[str, SensorFrame]:
    """What the expert's sensors see some seconds into its drive, in several conditions."""
    town_map = load_town_map(town)
    sensors = SensorSuite(camera_rig(SIZE_HW), roof_lidar(channels=64, azimuth_steps=1024))
    *_, moment = ExpertDrive(Traffic(town_map, SEED, 31, 20), at_s + 1.0).snapshots(int(at_s * 5) + 1, 0.2)
    world = World(town_map, SEED, CONDITIONS["clear"])
    return {
        name: world.under(conditions).render(
            moment.actors, sensors, moment.T_world_ego, moment.twist_ego, noise_seed=0, lights=moment.lights
        )
        for name, conditions in all_conditions.items()
    }


def sheet(cells: Sequence[tuple[str, np.ndarray]], columns: int) -> Image.Image:
    """Pictures of one size with their names, in rows."""
    height, width = cells[0][1].shape[:2]
    rows = -(-len(cells) // columns)
    page = Image.new("RGB", (columns * (width + GAP) - GAP, rows * (height + GAP) - GAP), "white")
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(16)
    for k, (name, picture) in enumerate(cells):
        at = (k % columns * (width + GAP), k // columns * (height + GAP))
        page.paste(Image.fromarray(picture), at)
        box = draw.textbbox((at[0] + 8, at[1] + 6), name, font=font)
        draw.rectangle((box[0] - 4, box[1] - 3, box[2] + 4, box[3] + 3), fill=(20, 24, 30))
        draw.text((at[0] + 8, at[1] + 6), name, font=font, fill="white")
    return page


def draw_from_above(sweep: LidarSweep, side_px: int) -> np.ndarray:
    """Returns from above, by intensity; forward is up."""
    xyz = (sweep.origin_ego + sweep.range_m[:, None] * sweep.dir_ego)[sweep.returned].numpy()
    colour = _colours(np.sqrt(np.minimum(sweep.intensity[sweep.returned].numpy() * BRIGHTER, 1.0)))
    picture = np.full((side_px, side_px, 3), 16, np.uint8)
    rows = ((REACH_M - xyz[:, 0]) / (2 * REACH_M) * side_px).astype(int)
    cols = ((REACH_M - xyz[:, 1]) / (2 * REACH_M) * side_px).astype(int)
    inside = (rows >= 0) & (rows < side_px) & (cols >= 0) & (cols < side_px)
    picture[rows[inside], cols[inside]] = colour[inside]
    return picture


def as_sensor_sees(sweep: LidarSweep, width_px: int) -> np.ndarray:
    """A row for each channel, a column for each azimuth, by range; black where nothing came back."""
    channels = int(sweep.beam.max()) + 1
    range_m = np.where(sweep.returned, sweep.range_m, np.nan).reshape(-1, channels).T[::-1]
    picture = _colours(1 - np.sqrt(np.nan_to_num(range_m, nan=100.0) / 100.0))
    picture[np.isnan(range_m)] = 0
    return cv2.resize(picture, (width_px, 4 * channels), interpolation=cv2.INTER_NEAREST)


def on_image(frame: SensorFrame, camera: str) -> np.ndarray:
    """The image with the returns on it, by range."""
    rig = camera_rig(SIZE_HW)
    index = rig.names.index(camera)
    sweep = frame.sweep
    xyz = (sweep.origin_ego + sweep.range_m[:, None] * sweep.dir_ego)[sweep.returned]
    in_camera = transform_points(inverse_se3(rig.T_ego_cam[index]), xyz)
    in_camera = in_camera[in_camera[:, 2] > 1.0]
    uv = (in_camera @ rig.K[index].T)[:, :2] / in_camera[:, 2:]
    picture = frame.images[camera].copy()
    colour = _colours(1 - np.sqrt(in_camera[:, 2].numpy().clip(max=80.0) / 80.0))
    u, v = uv.long().numpy().T
    inside = (u >= 0) & (u < SIZE_HW[1]) & (v >= 0) & (v < SIZE_HW[0])
    picture[v[inside], u[inside]] = colour[inside]
    return picture


def _colours(values: np.ndarray) -> np.ndarray:
    return (mpl.colormaps["plasma"](np.clip(values, 0, 1))[..., :3] * 255).astype(np.uint8)


def main() -> None:
    """Every town by day, one place in all conditions, one sweep in three views."""
    fair = {"clear": CONDITIONS["clear"]}
    days = {town: see(town, CONDITIONS if town == "Town05" else fair) for town in (*TOWNS, *TILES)}
    sheet([(town, frames["clear"].images["PCAM_F0"]) for town, frames in days.items()], 4).save(
        DOCS / "towns_places.jpg", quality=88
    )
    frames = days["Town05"]
    sheet([(name, frame.images["PCAM_F0"]) for name, frame in frames.items()], 3).save(
        DOCS / "towns_conditions.jpg", quality=88
    )
    side = 2 * SIZE_HW[0] + GAP
    views = [(name, draw_from_above(frames[name].sweep, side)) for name in ("clear", "rain", "fog")]
    sheet(views, 3).save(DOCS / "towns_lidar.png")
    clear = frames["clear"]
    width = 3 * side + 2 * GAP
    rows = Image.fromarray(as_sensor_sees(clear.sweep, width))
    cameras = sheet([(name, on_image(clear, name)) for name in ("PCAM_L0", "PCAM_F0", "PCAM_R0")], 3)
    cameras = cameras.resize((width, round(cameras.height * width / cameras.width)))
    page = Image.new("RGB", (width, rows.height + GAP + cameras.height), "white")
    page.paste(rows, (0, 0))
    page.paste(cameras, (0, rows.height + GAP))
    page.save(DOCS / "towns_sensor_view.jpg", quality=88)


if __name__ == "__main__":
    main()
