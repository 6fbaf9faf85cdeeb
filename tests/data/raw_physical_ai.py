"""Two clips of NVIDIA's PhysicalAI-Autonomous-Vehicles by its published columns; only the first has sensors.

The car drives 10 m/s along x and 5 m/s along y of the anchor frame, at a yaw of 0.4 + t.
"""

from pathlib import Path
from typing import Any

import av
import DracoPy
import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

CLIP = "00aa11bb-22cc-33dd-44ee-55ff66001122"
OTHER = "11bb22cc-33dd-44ee-55ff-660011223344"
SPINS_US = [-20_000, 80_000, 180_000]
CAMERA = "camera_front_wide_120fov"
LATE_US = 17_164
"""A time as Draco's green and blue: 105 ms - LATE_US * 210 ms / 65,535, which is 50 ms after the start."""


def pose(t_us: int) -> np.ndarray:
    """Return T_anchor_rig."""
    T, t_s = np.eye(4), t_us * 1e-6
    T[:3, :3] = Rotation.from_euler("z", 0.4 + t_s).as_matrix()
    T[:3, 3] = 10 * t_s, 5 * t_s, 0.1
    return T


def write(root: Path) -> None:
    """Write one chunk, unpacked as py123d reads it."""
    index = pd.Index([CLIP, OTHER], name="clip_id")
    clips = pd.DataFrame({"chunk": 0, "split": "val", "clip_is_valid": True}, index=index)
    size = {"length": 5.0, "width": 2.0, "height": 1.5, "rear_axle_to_bbox_center": 1.4, "wheelbase": 2.85}
    _calibration(root, "vehicle_dimensions", pd.DataFrame(size | {"track_width": 1.6}, index=index))
    lens = {"width": 64, "height": 48, "cx": 32.5, "cy": 24.0}
    lens |= {f"{way}_poly_{k}": float(k == 1) for way in ("fw", "bw") for k in range(5)}
    _calibration(root, "camera_intrinsics", _of_sensors({CAMERA: lens}))
    forward, left = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5]), Rotation.from_euler("z", 90, degrees=True)
    mounts = {CAMERA: _pose(forward, (1.7, 0.1, 1.4)), "lidar_top_360fov": _pose(left, (1.2, 0.0, 1.9))}
    _calibration(root, "sensor_extrinsics", _of_sensors(mounts))
    clips.to_parquet(root / "clip_index.parquet")
    ego = [
        {"timestamp": t_us, **_pose(Rotation.from_matrix(T[:3, :3]), T[:3, 3]), "vx": 10.0, "vy": 5.0}
        for t_us in range(-50_000, 300_001, 10_000)
        for T in [pose(t_us)]
    ]
    still = dict.fromkeys(("vz", "ax", "ay", "az", "curvature"), 0.0)
    _table(root / f"labels/egomotion/{CLIP}.egomotion.parquet", [row | still for row in ego])
    # 8 m ahead of a lidar that looks left; one point in the middle of the spin, one at its start
    points = np.array([[8, 1, -1.9], [4, 0, 0]], np.float32)
    colors = np.array([[51, LATE_US & 255, LATE_US >> 8], [255, 0, 128]], np.uint8)
    cloud = DracoPy.encode(points, colors=colors, quantization_bits=20)
    _table(
        root / f"lidar/lidar_top_360fov/{CLIP}.lidar_top_360fov.parquet",
        [
            {"spin_index": k, "reference_timestamp": t, "draco_encoded_pointcloud": cloud}
            for k, t in enumerate(SPINS_US)
        ],
    )
    _video(root / f"camera/{CAMERA}")


def write_boxes(root: Path) -> None:
    """Write the boxes of the first two spins: a car ahead to the left, and a rider who is seen once."""
    turned = dict(zip(("x", "y", "z", "w"), Rotation.from_euler("z", 0.3).as_quat(), strict=True))
    rows = []
    for track, kind, t_us, centre in [
        ("7", "automobile", SPINS_US[0] + 90_000, (12.0, 3.0, 0.8)),
        ("7", "automobile", SPINS_US[1] + 90_000, (12.0, 3.0, 0.8)),
        ("8", "rider", SPINS_US[1] + 50_000, (6.0, -2.0, 0.9)),
    ]:
        row: dict[str, Any] = {"track_id": track, "label_class": kind, "timestamp_us": t_us}
        row |= {"reference_frame": "rig", "reference_frame_timestamp_us": t_us, "source": "autolabel"}
        row |= {f"center_{axis}": value for axis, value in zip("xyz", centre, strict=True)}
        row |= {f"size_{axis}": value for axis, value in zip("xyz", (4.5, 1.9, 1.6), strict=True)}
        rows.append(row | {f"orientation_{axis}": value for axis, value in turned.items()})
    _table(root / f"labels/obstacle.offline/{CLIP}.obstacle.offline.parquet", rows)


def _pose(turn: Rotation, position: Any) -> dict[str, float]:
    values = [*turn.as_quat(), *position]
    return dict(zip(("qx", "qy", "qz", "qw", "x", "y", "z"), values, strict=True))


def _of_sensors(rows: dict[str, dict[str, float]]) -> pd.DataFrame:
    """Return the rows of each clip's sensors, by clip and name."""
    index = pd.MultiIndex.from_product([[CLIP, OTHER], rows], names=["clip_id", "sensor_name"])
    return pd.DataFrame([*rows.values()] * 2, index=index)


def _calibration(root: Path, name: str, table: pd.DataFrame) -> None:
    file = root / "calibration" / name / f"{name}.chunk_0000.parquet"
    file.parent.mkdir(parents=True)
    table.to_parquet(file)


def _table(file: Path, rows: list[dict[str, Any]]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_parquet(file)


def _video(folder: Path) -> None:
    """Write 10 images at 30 Hz from -10 ms on, each 20 brighter than the one before."""
    folder.mkdir(parents=True)
    with av.open(folder / f"{CLIP}.{CAMERA}.mp4", "w") as file:
        stream = file.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for k in range(10):
            image = np.full((48, 64, 3), 30 + 20 * k, np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        file.mux(stream.encode())
    _table(
        folder / f"{CLIP}.{CAMERA}.timestamps.parquet",
        [{"timestamp": -10_000 + 33_333 * k} for k in range(10)],
    )
