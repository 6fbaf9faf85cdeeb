"""A KITTI-360 root of one drive with three frames, after its published folders and files."""

from pathlib import Path

import numpy as np
from PIL import Image

DRIVE = "2013_05_28_drive_0000_sync"
POINT = np.array([10.0, 2.0, -1.0, 0.5], dtype=np.float32)
"""In the lidar's frame, which is the IMU's with y to the left and z up."""
DYNAMIC, STATIC = (10.0, -2.0, -0.8), (20.0, 0.0, -0.9)
"""Centres of a car that moves by 1 m between the frames, and of one that stands, in the world frame."""


def write(root: Path) -> None:
    """The vehicle moves by 1 m along the world's x; the IMU's y points right and its z down."""
    _calibration(root / "calibration")
    for stream in ("image_00", "image_01", "image_02", "image_03"):
        _times(root / "data_2d_raw" / DRIVE / stream)
    _times(root / "data_3d_raw" / DRIVE / "velodyne_points")
    images = root / "data_2d_raw" / DRIVE / "image_00" / "data_rect"
    images.mkdir()
    sweeps = root / "data_3d_raw" / DRIVE / "velodyne_points" / "data"
    sweeps.mkdir()
    on_static = np.array([[STATIC[0] + 0.01 * k, 0.0, STATIC[2], 0.2] for k in range(-25, 25)], np.float32)
    for frame in range(3):
        Image.new("RGB", (32, 16), (10, 200, 30)).save(images / f"{frame:010d}.png")
        here = on_static - [frame, 0, 0, 0]
        np.concatenate([POINT[None], here]).astype(np.float32).tofile(sweeps / f"{frame:010d}.bin")
    poses = root / "data_poses" / DRIVE
    poses.mkdir(parents=True)
    poses.joinpath("poses.txt").write_text(
        "".join(f"{frame} 1 0 0 {frame} 0 -1 0 0 0 0 -1 0\n" for frame in range(3))
    )
    boxes = root / "data_3d_bboxes" / "train"
    boxes.mkdir(parents=True)
    moving = "".join(
        _object(10 + k, (DYNAMIC[0] + k, *DYNAMIC[1:]), timestamp=k, instance=7, dynamic=1) for k in range(3)
    )
    standing = _object(20, STATIC, timestamp=-1, instance=9, dynamic=0)
    boxes.joinpath(f"{DRIVE}.xml").write_text(f"<opencv_storage>{moving}{standing}{_road()}</opencv_storage>")


def _times(folder: Path) -> None:
    folder.mkdir(parents=True)
    lines = [f"2013-05-28 08:46:0{2 + frame}.500000000" for frame in range(3)]
    folder.joinpath("timestamps.txt").write_text("\n".join(lines) + "\n")


def _calibration(folder: Path) -> None:
    folder.mkdir(parents=True)
    ahead = "0 0 1 0 1 0 0 0 0 1 0 0"  # of cameras: x is the IMU's y, y its z, z its x
    folder.joinpath("calib_cam_to_pose.txt").write_text(
        "".join(f"image_0{camera}: {ahead}\n" for camera in range(4))
    )
    folder.joinpath("calib_cam_to_velo.txt").write_text("0 0 1 0 -1 0 0 0 0 -1 0 0\n")
    folder.joinpath("perspective.txt").write_text(
        "".join(
            f"S_rect_0{camera}: 32 16\nR_rect_0{camera}: 1 0 0 0 1 0 0 0 1\n"
            f"P_rect_0{camera}: 100 0 16 0 0 100 8 0 0 0 1 0\n"
            for camera in range(2)
        )
    )
    for camera in (2, 3):
        folder.joinpath(f"image_0{camera}.yaml").write_text(
            "%YAML:1.0\nimage_width: 32\nimage_height: 16\nmirror_parameters:\n   xi: 2.2\n"
            "distortion_parameters:\n   k1: 0.1\n   k2: 0.1\n   p1: 0.0\n   p2: 0.0\n"
            "projection_parameters:\n   gamma1: 20.0\n   gamma2: 20.0\n   u0: 16.0\n   v0: 8.0\n"
        )


def _matrix(name: str, values: np.ndarray) -> str:
    data = " ".join(f"{value:g}" for value in values.reshape(-1))
    rows, columns = values.shape
    return f"<{name}><rows>{rows}</rows><cols>{columns}</cols><dt>f</dt><data>{data}</data></{name}>"


def _object(
    index: int, centre: tuple[float, ...], *, timestamp: int, instance: int, dynamic: int, label: str = "car"
) -> str:
    """A car of 4 × 2 × 1.6 m without rotation, as its unit cube and a transform."""
    transform = np.diag([4.0, 2.0, 1.6, 1.0])
    transform[:3, 3] = centre
    x, y, z = np.meshgrid([0.5, -0.5], [0.5, -0.5], [0.5, -0.5], indexing="ij")
    cube = np.stack([x, y, z], axis=-1).reshape(-1, 3)[[0, 1, 2, 3, 5, 4, 6, 7]]
    return (
        f"<object{index}><index>{index}</index><label>{label}</label><semanticId>13</semanticId>"
        f"<instanceId>{instance}</instanceId><dynamic>{dynamic}</dynamic><timestamp>{timestamp}</timestamp>"
        f"<start_frame>0</start_frame><end_frame>1</end_frame>"
        f"{_matrix('transform', transform)}{_matrix('vertices', cube)}</object{index}>"
    )


def _road() -> str:
    corners = np.array([[-20, -5, -1.7], [60, -5, -1.7], [60, 5, -1.7], [-20, 5, -1.7], [-20, -5, -1.7]])
    return (
        "<object99><index>99</index><label>road</label><semanticId>7</semanticId><timestamp>-1</timestamp>"
        f"{_matrix('transform', np.eye(4))}{_matrix('vertices', corners)}"
        "<transform_plane><rows>0</rows></transform_plane></object99>"
    )
