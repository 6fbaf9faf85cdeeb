"""A raw PandaSet log of one frame, as small as its parser takes it."""

import gzip
import json
import pickle
from pathlib import Path
from typing import Any

import pandas as pd
from PIL import Image

CAMERAS = ("front", "front_left", "front_right", "left", "right", "back")
CUBOIDS, SEMSEG, LIDAR = "annotations/cuboids/00.pkl.gz", "annotations/semseg/00.pkl.gz", "lidar/00.pkl.gz"


def write(folder: Path) -> None:
    """One car 10 m ahead of the lidar, three points, six black images."""
    cuboid = {
        "uuid": ["a-car"],
        "label": ["Car"],
        "yaw": [0.5],
        "position.x": [1.0],
        "position.y": [10.0],
        "position.z": [0.8],
        "dimensions.x": [1.9],
        "dimensions.y": [4.7],
        "dimensions.z": [1.6],
        "cuboids.sibling_id": ["-"],
        "cuboids.sensor_id": [-1],
        "attributes.rider_status": [float("nan")],
    }
    points = {
        "x": [1.0, 2.0, 3.0],
        "y": [5.0] * 3,
        "z": [0.0] * 3,
        "i": [7.0] * 3,
        "t": [100.0] * 3,
        "d": [0, 0, 1],
    }
    write_pickle(folder / CUBOIDS, table(cuboid))
    write_pickle(folder / SEMSEG, table({"class": [5, 6, 7]}))
    write_pickle(folder / LIDAR, table(points))
    (folder / "meta").mkdir()
    (folder / "meta" / "timestamps.json").write_text("[100.1]")
    pose = {"position": dict.fromkeys("xyz", 0.0), "heading": {"w": 0.5, "x": -0.5, "y": 0.5, "z": -0.5}}
    for name in CAMERAS:
        camera = folder / "camera" / f"{name}_camera"
        camera.mkdir(parents=True)
        (camera / "poses.json").write_text(json.dumps([pose]))
        (camera / "timestamps.json").write_text("[100.0]")
        (camera / "intrinsics.json").write_text('{"fx": 1970, "fy": 1970, "cx": 970, "cy": 483}')
        Image.new("RGB", (1920, 1080)).save(camera / "00.jpg")


def table(columns: dict[str, list[Any]]) -> pd.DataFrame:
    """A table whose strings are Python's, as in the real files, not those of pandas 3."""
    data = {
        name: pd.Series(v, dtype=object if isinstance(v[0], str) else None) for name, v in columns.items()
    }
    return pd.DataFrame(data).set_axis(pd.Index(columns, dtype=object), axis=1)


def write_pickle(file: Path, value: Any) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with gzip.open(file, "wb") as out:
        pickle.dump(value, out, protocol=4)


def write_drive(folder: Path, frames: int, first: int = 0) -> None:
    """Write frames at 10 Hz of a vehicle that drives 1 m in each; the files are numbered from `first`."""
    write(folder)
    meta, cameras = folder / "meta", [folder / "camera" / f"{name}_camera" for name in CAMERAS]
    for file in (CUBOIDS, SEMSEG, LIDAR, *(f"camera/{camera.name}/00.jpg" for camera in cameras)):
        whole = (folder / file).read_bytes()
        (folder / file).unlink()
        for frame in range(frames):
            (folder / file.replace("00.", f"{first + frame:02d}.")).write_bytes(whole)
    for frame in range(frames):
        sweep = {
            "x": [1.0, 2.0, 3.0],
            "y": [5.0 + frame] * 3,
            "z": [0.0] * 3,
            "i": [7.0] * 3,
            "t": [100.0 + 0.1 * frame] * 3,
            "d": [0, 0, 1],
        }
        write_pickle(folder / f"lidar/{first + frame:02d}.pkl.gz", table(sweep))
    (meta / "timestamps.json").write_text(json.dumps([100.1 + 0.1 * frame for frame in range(frames)]))
    for camera in cameras:
        (pose,) = json.loads((camera / "poses.json").read_text())
        poses = [pose | {"position": pose["position"] | {"y": float(frame)}} for frame in range(frames)]
        (camera / "poses.json").write_text(json.dumps(poses))
        (camera / "timestamps.json").write_text(json.dumps([100.0 + 0.1 * frame for frame in range(frames)]))
