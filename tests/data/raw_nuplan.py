"""A log of nuPlan by the schema of its data bases: 24 sweeps at 20 Hz, of which every second has an image.

The minivan drives 10 m/s to the north-east of UTM coordinates, and turns to the left.
"""

import importlib
import pickle
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

LOG = "2021.05.12.19.36.12_veh-35_00005_00204"
"""A log of the published train split."""
START_US = 1_620_848_172_000_000
LATE_US = 5_000
"""Time of an image after its sweep."""
ORIGIN = np.array([664_430.25, 3_997_650.5, 606.5])

_TABLES = {
    "log": "vehicle_name date timestamp logfile location map_version",
    "ego_pose": (
        "timestamp x y z qw qx qy qz vx vy vz acceleration_x acceleration_y acceleration_z "
        "angular_rate_x angular_rate_y angular_rate_z epsg log_token"
    ),
    "lidar": "log_token channel model translation rotation",
    "camera": "log_token channel model translation rotation intrinsic distortion width height",
    "scene": "log_token name goal_ego_pose_token roadblock_ids",
    "lidar_pc": "next_token prev_token ego_pose_token lidar_token scene_token filename timestamp",
    "image": "next_token prev_token ego_pose_token camera_token filename_jpg timestamp",
    "category": "name description",
    "track": "category_token width length height",
    "lidar_box": (
        "lidar_pc_token track_token next_token prev_token x y z width length height vx vy vz yaw confidence"
    ),
    "traffic_light_status": "lidar_pc_token lane_connector_id status",
    "scenario_tag": "lidar_pc_token type agent_track_token",
}
"""Columns of each table after its token, in the published order."""


def pose(t_us: int) -> np.ndarray:
    """Return T_world_rear, whose origin is the rear axle."""
    T, t_s = np.eye(4), (t_us - START_US) * 1e-6
    T[:3, :3] = Rotation.from_euler("z", np.pi / 4 + 0.2 * t_s).as_matrix()
    T[:3, 3] = ORIGIN + 10 * t_s * np.array([0.6, 0.8, 0])
    return T


def write(root: Path, intrinsic: bytes | None = None) -> None:
    """Write a data base of the mini split, with camera and lidar.

    Args:
        intrinsic: bytes of that column; None: the camera's matrix.
    """
    lists = importlib.import_module("nuplan.database.common.data_types")
    sensors = root / "nuplan-v1.1" / "sensor_blobs"
    file = root / "nuplan-v1.1" / "splits" / "mini" / f"{LOG}.db"
    file.parent.mkdir(parents=True)
    base = sqlite3.connect(file)
    for table, columns in _TABLES.items():
        base.execute(f"CREATE TABLE {table} (token BLOB PRIMARY KEY, {', '.join(columns.split())})")

    def add(table: str, row: bytes, *values: Any) -> None:
        base.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * (1 + len(values)))})", (row, *values))

    log, scene, lidar, camera, track, kind = (token("one", k) for k in range(6))
    add("log", log, "veh-35", "2021-05-12", START_US, LOG, "las_vegas", "us-nv-las-vegas-strip")
    place, turn = lists.Translation([1.6, 0.1, 1.5]), lists.Rotation([0.5, -0.5, 0.5, -0.5])
    mount = pickle.dumps(place), pickle.dumps(turn)
    matrix = lists.CameraIntrinsic([[40.0, 0, 30.0], [0, 42.0, 25.0], [0, 0, 1.0]])
    lens = intrinsic or pickle.dumps(matrix), pickle.dumps([-0.3, 0.1, 0.001, 0.002, -0.05])
    add("camera", camera, log, "CAM_F0", "pinhole", *mount, *lens, 64, 48)
    add("lidar", lidar, log, "MergedPointCloud", "merged", *mount)
    add("scene", scene, log, "scene-1", None, "17 18 ")
    add("category", kind, "bicycle", "")
    add("track", track, kind, 0.7, 1.8, 1.7)
    for k in range(130):
        T = pose(START_US + 10_000 * k)
        turned = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
        motion = [10.0, 0, 0, 0.5, 0, 0, 0, 0, 0.2]
        add("ego_pose", token("ego", k), START_US + 10_000 * k, *T[:3, 3], *turned, *motion, 32611, log)
    for folder in ("CAM_F0", "MergedPointCloud"):
        (sensors / LOG / folder).mkdir(parents=True)
    for k in range(24):
        t_us, sweep, ego = START_US + 50_000 * k, token("sweep", k), token("ego", 5 * k)
        name = f"{LOG}/MergedPointCloud/{sweep.hex()}.pcd"
        add("lidar_pc", sweep, None, None, ego, lidar, scene, name, t_us)
        _pcd(sensors / name)
        # A bicycle 12 m to the east that drives 4 m/s to the north
        box = [*np.add(ORIGIN, (12.0, 0.2 * k, 0.5)), 0.7, 1.8, 1.7, 0, 4.0, 0, np.pi / 2, 1.0]
        add("lidar_box", token("box", k), sweep, track, None, None, *box)
        add("traffic_light_status", token("light", k), sweep, 4711, "red" if k < 12 else "green")
        if k % 2:
            name = f"{LOG}/CAM_F0/{k}.jpg"
            add("image", token("image", k), None, None, ego, camera, name, t_us + LATE_US)
            Image.new("RGB", (64, 48), (200, 100, 10 * k)).save(sensors / name, quality=95)
    base.commit()
    base.close()


def token(kind: str, number: int) -> bytes:
    """Return a token of 8 bytes, as nuPlan's are."""
    return f"{kind[:4]:_<4}{number:04}".encode()


def _pcd(file: Path) -> None:
    """Write a point of the top lidar on the ground, and one of the right lidar."""
    names = ("x", "y", "z", "intensity", "ring", "lidar_info")
    kinds = [*((name, "<f4") for name in names[:4]), *((name, "u1") for name in names[4:])]
    points = np.array([(10, 2, -0.4385, 51, 7, 0), (3, -4, 1, 255, 1, 2)], kinds)
    size = "SIZE 4 4 4 4 1 1\nTYPE F F F F U U\nCOUNT 1 1 1 1 1 1\nPOINTS 2\nDATA binary\n"
    header = f"VERSION 0.7\nFIELDS {' '.join(names)}\n{size}"
    file.write_bytes(header.encode() + points.tobytes())
