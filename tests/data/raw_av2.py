"""An Argoverse 2 log: sweeps, poses, an empty map; cameras and annotations where they are asked for."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from PIL import Image
from pyarrow import feather

START_NS = 315_966_265_000_000_000
UPRIGHT = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0}
AHEAD = {"qw": 0.5, "qx": -0.5, "qy": 0.5, "qz": -0.5}
CAMERAS = ("ring_front_center", "ring_front_left")


def times_ns(frames: int) -> list[int]:
    return [START_NS + 100_000_000 * k for k in range(frames)]


def write(folder: Path, *, cameras: bool = False, annotated: bool = False, frames: int = 2) -> None:
    """The vehicle drives along x at 10 m/s; the points of sweep k are 10 + k and 20 + k m ahead.

    A car drives 8 m ahead of it. Images come every 50 ms, from 5 ms after the first sweep begins.
    """
    swept_ns = times_ns(frames)
    exposed_ns = [START_NS + 5_000_000 + 50_000_000 * k for k in range(2 * frames)]
    for part in ("calibration", "map", "sensors/lidar"):
        (folder / part).mkdir(parents=True)
    mounts = [_place(1.0, 1.8) | {"sensor_name": name} for name in ("up_lidar", "down_lidar")]
    if cameras:
        mounts += [_place(1.0, 1.5) | AHEAD | {"sensor_name": name} for name in CAMERAS]
        for name in CAMERAS:
            images = folder / "sensors" / "cameras" / name
            images.mkdir(parents=True)
            for t_ns in exposed_ns:
                Image.new("RGB", (32, 16), (200, 10, 30)).save(images / f"{t_ns}.jpg")
        lens = {"fx_px": 40.0, "fy_px": 40.0, "cx_px": 16.0, "cy_px": 8.0, "k1": 0.0, "k2": 0.0, "k3": 0.0}
        size = {"width_px": 32, "height_px": 16}
        lenses = [lens | size | {"sensor_name": name} for name in CAMERAS]
        _write(folder / "calibration" / "intrinsics.feather", lenses)
    _write(folder / "calibration" / "egovehicle_SE3_sensor.feather", mounts)
    poses = [
        _place(1e-8 * (t_ns - START_NS), 0.0) | {"timestamp_ns": t_ns}
        for t_ns in sorted([*swept_ns, *exposed_ns])
    ]
    _write(folder / "city_SE3_egovehicle.feather", poses)
    if annotated:
        car = {"category": "REGULAR_VEHICLE", "track_uuid": "a", "num_interior_pts": 5}
        size = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5}
        boxes = [_place(8.0, 0.8) | size | car | {"timestamp_ns": t_ns} for t_ns in swept_ns]
        _write(folder / "annotations.feather", boxes)
    for k, t_ns in enumerate(swept_ns):
        point = {"y": 0.0, "z": 0.5, "intensity": 9, "laser_number": 3, "offset_ns": 0}
        _write(folder / "sensors" / "lidar" / f"{t_ns}.feather", [point | {"x": x + k} for x in (10.0, 20.0)])
    corners = [{"x": x, "y": y, "z": 0.0} for x, y in ((0, 0), (20, 0), (20, 20), (0, 20))]
    city = {"pedestrian_crossings": {}, "lane_segments": {}}
    areas = {"drivable_areas": {"1": {"id": 1, "area_boundary": corners}}}
    (folder / "map" / f"log_map_archive_{folder.name}____PIT_city_1.json").write_text(
        json.dumps(city | areas)
    )


def _place(x: float, z: float) -> dict[str, Any]:
    return UPRIGHT | {"tx_m": x, "ty_m": 0.0, "tz_m": z}


def _write(file: Path, rows: list[dict[str, Any]]) -> None:
    columns = {
        name: np.array(
            [row[name] for row in rows], np.uint8 if name in ("intensity", "laser_number") else None
        )
        for name in rows[0]
    }
    feather.write_feather(pa.table(columns), file)
