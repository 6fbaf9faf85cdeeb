"""Pictures and descriptions of search hits: camera beside lidar from above, and words."""

import functools
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from foredrive.data.cameras import find_camera, pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.scene import Category, LidarSweep
from foredrive.search.find import Hit
from foredrive.view import palette

HEIGHT_PX, WIDTH_PX = 198, 352
"""Size of the camera's picture, px; the lidar's picture is square and has the same height."""
GAP_PX = 4
REACH_M = 40.0
"""Half width of the lidar's picture, m."""


def hit_picture(hit: Hit, *, lidar: bool = True) -> UInt8[np.ndarray, "H W 3"]:
    """Draw camera and lidar side by side, in the same size for every hit. A missing sensor is left dark.

    A whole scene shows its front camera. For any other view, a mark at the lidar's edge shows its direction.

    Args:
        lidar: False leaves the lidar's picture out, and the dark edges of the camera's.
    """
    canvas = Image.new("RGB", (WIDTH_PX + GAP_PX + HEIGHT_PX, HEIGHT_PX), palette.GROUND)
    canvas.paste(palette.PANEL, (0, 0, WIDTH_PX, HEIGHT_PX))
    canvas.paste(palette.PANEL, (WIDTH_PX + GAP_PX, 0, canvas.width, HEIGHT_PX))
    row = hit.row
    try:
        log = _opened(row.folder, row.maps_dir)
        picture, sweep = _camera(log, row.frame, row.view), read_sweep(log, row.frame)
    except InputError:
        ImageDraw.Draw(canvas).text((12, 12), f"{row.folder} cannot be read", fill=palette.FAINT)
        return np.asarray(canvas)
    if picture is not None and not lidar:
        return np.asarray(picture)
    if picture is not None:
        canvas.paste(picture, ((WIDTH_PX - picture.width) // 2, (HEIGHT_PX - picture.height) // 2))
    if sweep is not None:
        above = Image.fromarray(lidar_from_above(sweep[0], HEIGHT_PX))
        if row.azimuth_deg is not None:
            _point(above, row.azimuth_deg)
        canvas.paste(above, (WIDTH_PX + GAP_PX, 0))
    return np.asarray(canvas if lidar else canvas.crop((0, 0, WIDTH_PX, HEIGHT_PX)))


def lidar_from_above(sweep: LidarSweep, size_px: int) -> UInt8[np.ndarray, "S S 3"]:
    """Draw returns coloured by range, x up, with the vehicle in the middle."""
    hits = sweep[sweep.valid & sweep.returned]
    points, range_m = hits.points_ego.numpy(), hits.range_m.numpy()
    scale = size_px / 2 / REACH_M
    # Forward is up and left is on the left, as in all views from above
    column = (size_px / 2 - points[:, 1] * scale).astype(int)
    row = (size_px / 2 - points[:, 0] * scale).astype(int)
    inside = (column >= 0) & (column < size_px) & (row >= 0) & (row < size_px)
    picture = np.full((size_px, size_px, 3), palette.rgb255(palette.PANEL), dtype=np.uint8)
    picture[row[inside], column[inside]] = palette.range_colours(range_m[inside])
    # A car of 4.4 m x 1.8 m around the rear axle, at least two pixels wide
    half_h, half_w = round(2.2 * scale), max(1, round(0.9 * scale))
    middle = size_px // 2
    picture[middle - half_h : middle + half_h, middle - half_w : middle + half_w] = palette.rgb255(
        palette.EGO
    )
    return picture


def hit_name(hit: Hit) -> str:
    """Return the name of the hit in the format of `--like`: LOG@12.5s/VIEW."""
    return f"{hit.row.log}@{hit.row.t_s:.2f}s/{hit.row.view}"


def score_text(hit: Hit) -> str:
    """Return the scores that ranked the hit, as text."""
    return "   ".join(f"{name} {score:.3f}" for name, score in hit.scores.items()) or f"{hit.score:.3f}"


def content_text(hit: Hit) -> str:
    """Return place, weather, speed and objects as text, as far as they are known."""
    row = hit.row
    facts = [fact for fact in (row.place, row.time_of_day, row.weather) if fact is not None]
    if row.ego_speed_mps is not None:
        facts.append(f"{row.ego_speed_mps:.1f} m/s")
    objects = [
        _counted(count, palette.label(category))
        for category, count in row.counts.items()
        if count and category in (Category.CAR, Category.TRUCK, Category.BUS, Category.PEDESTRIAN)
    ]
    return ", ".join([*facts, *objects])


def _point(above: Image.Image, azimuth_deg: float) -> None:
    """Mark the direction of the sector's centre."""
    middle, along = (
        HEIGHT_PX / 2,
        np.array([-np.sin(np.deg2rad(azimuth_deg)), -np.cos(np.deg2rad(azimuth_deg))]),
    )
    start, end = middle + 0.86 * middle * along, middle + 0.98 * middle * along
    ImageDraw.Draw(above).line([*start, *end], fill=palette.EXPERT, width=3)


def _counted(count: int, kind: str) -> str:
    return f"{count} {kind}" + ("" if count == 1 else "es" if kind.endswith("s") else "s")


@functools.lru_cache(maxsize=16)
def _opened(folder: Path, maps_dir: Path) -> Log:
    return Log(LogPath(folder, maps_dir))


def _camera(log: Log, frame: int, view: str) -> Image.Image | None:
    cameras = pinhole_cameras(log)
    metadata = find_camera(cameras, view) or next(iter(cameras.values()), None)
    if metadata is None:
        return None
    scale = min(WIDTH_PX / metadata.width, HEIGHT_PX / metadata.height)
    size_hw = (round(metadata.height * scale), round(metadata.width * scale))
    image = read_camera(log, frame, metadata, size_hw, with_image=True).image
    return None if image is None else Image.fromarray(image.permute(1, 2, 0).numpy())
