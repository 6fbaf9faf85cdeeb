"""Folders of nerfstudio: axes, times and calibrations come out right, and bad files are one line."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.convert import convert
from foredrive.data.logs import Log
from foredrive.errors import InputError

SHARED = {"w": 32, "h": 16, "fl_x": 40.0, "fl_y": 41.0, "cx": 16.0, "cy": 8.0, "camera_model": "OPENCV"}
AHEAD = np.array([[0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 1.5], [0, 0, 0, 1]], float)
"""A camera in the axes of OpenGL (x right, y up, z back) that looks along x, 1.5 m above the ground."""


def moved(x: float, y: float = 0.0) -> list:
    T = AHEAD.copy()
    T[:2, 3] += x, y
    return T.tolist()


def write(folder: Path, frames: list[dict], **shared: object) -> Path:
    (folder / "images").mkdir(parents=True)
    for frame in frames:
        file = folder / str(frame.get("file_path", "x.png"))
        if file.parent == folder / "images":
            Image.new("RGB", (32, 16), (200, 30, 10)).save(file)
    (folder / "transforms.json").write_text(json.dumps(SHARED | shared | {"frames": frames}))
    return folder


def frame(name: str, x: float, **values: object) -> dict:
    return {"file_path": f"images/{name}.png", "transform_matrix": moved(x)} | values


def test_one_camera(tmp_path: Path) -> None:
    """The images are not in order in the file; without times they are 0.1 s apart in the order of names."""
    folder = write(tmp_path / "scene_1", [frame("b", 2.0), frame("a", 1.0), frame("c", 3.0)])
    (path,) = convert(folder, "nerfstudio", tmp_path / "out")
    assert path.name == "own_train/scene_1"
    log = Log(path)
    assert np.diff(log.t_us).tolist() == [100_000, 100_000]
    expected = np.tile(np.eye(4), (3, 1, 1))
    expected[:, 0, 3] = [1, 2, 3]
    np.testing.assert_allclose(log.T_world_ego, expected, atol=1e-6)
    camera = read_camera(log, 1, pinhole_cameras(log)["front"], (16, 32), with_image=True)
    torch.testing.assert_close(camera.K, torch.tensor([[40.0, 0, 16], [0, 41, 8], [0, 0, 1]]))
    # ahead of the vehicle is the camera's z, and its y is down
    assert camera.T_ego_cam[:3, 2].tolist() == pytest.approx([1, 0, 0])
    assert camera.T_ego_cam[:3, 1].tolist() == pytest.approx([0, 0, -1])
    assert camera.T_ego_cam[:3, 3].tolist() == pytest.approx([0, 0, 1.5])


def test_two_cameras_at_the_same_times(tmp_path: Path) -> None:
    """The second camera is 0.5 m to the left and has another lens; one of its images is missing."""
    left = {"transform_matrix": moved(0.0, 0.5), "fl_x": 50.0, "k1": 0.1}
    frames = [
        frame("a0", 0.0, timestamp=5.0),
        frame("b0", 0.0, timestamp=5.0) | left,
        frame("a1", 1.0, timestamp=5.5),
    ]
    (path,) = convert(write(tmp_path / "two", frames), "nerfstudio", tmp_path / "out")
    log = Log(path)
    assert log.t_us.tolist() == [5_000_000, 5_500_000]
    cameras = pinhole_cameras(log)
    second = read_camera(log, 0, cameras["camera_1"], (16, 32), with_image=True)
    assert second.T_ego_cam[:3, 3].tolist() == pytest.approx([0, 0.5, 1.5])
    assert second.K[0, 0].item() == pytest.approx(50.0)
    assert second.dist[0].item() == pytest.approx(0.1)
    assert read_camera(log, 1, cameras["camera_1"], (16, 32), with_image=True).image is None


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ({"transform_matrix": [[1, 2], [3]]}, "transform_matrix must be 4 rows of 4"),
        ({"transform_matrix": np.full((4, 4), np.nan).tolist()}, "4 finite numbers"),
        ({"transform_matrix": (2 * AHEAD).tolist()}, "a rotation that is none|last row"),
        ({"file_path": "../../secret.png"}, "lies outside of the folder"),
        ({"file_path": "images/none.png"}, "cannot read the image"),
        ({"camera_model": "OPENCV_FISHEYE"}, "undistort the images first"),
        ({"fl_x": "forty"}, "fl_x must be a finite number"),
        ({"w": 0}, "must be above 0"),
        ({"w": 64}, r"image of front is \(16, 32\)"),
        ({"timestamp": float("inf")}, "timestamp must be a finite number"),
    ],
)
def test_a_bad_entry_is_one_line(entry: dict, told: str, tmp_path: Path) -> None:
    made = frame("a", 0.0) | entry
    folder = write(tmp_path / "bad", [made] if "file_path" not in entry else [frame("a", 0.0), made])
    if "file_path" in entry and "none" in str(entry["file_path"]):
        (folder / "images" / "none.png").unlink()
    with pytest.raises(InputError, match=told) as refused:
        convert(folder, "nerfstudio", tmp_path / "out")
    assert "\n" not in str(refused.value)
    assert "bad" in str(refused.value)
    assert not list((tmp_path / "out").rglob("*.arrow"))
