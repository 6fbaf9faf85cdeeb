"""Folders of nerfstudio: axes, times and calibrations come out right, and bad files are one line."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.formats.convert import convert
from foredrive.data.logs import Log
from foredrive.data.notices import read_notices
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
        if folder / "images" in file.parents:
            file.parent.mkdir(exist_ok=True)
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
    second = read_camera(log, 0, cameras["b"], (16, 32), with_image=True)
    assert second.T_ego_cam[:3, 3].tolist() == pytest.approx([0, 0.5, 1.5])
    assert second.K[0, 0].item() == pytest.approx(50.0)
    assert second.dist[0].item() == pytest.approx(0.1)
    assert read_camera(log, 1, cameras["b"], (16, 32), with_image=True).image is None


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ({"transform_matrix": [[1, 2], [3]]}, "transform_matrix must be 4 rows of 4"),
        ({"transform_matrix": np.full((4, 4), np.nan).tolist()}, "4 finite numbers"),
        ({"transform_matrix": (2 * AHEAD).tolist()}, "a matrix that is no rotation|last row"),
        ({"file_path": "../../secret.png"}, "lies outside of the folder"),
        ({"file_path": "images/none.png"}, "cannot read the image"),
        ({"camera_model": "OPENCV_FISHEYE"}, "undistort the images first"),
        ({"fl_x": "forty"}, "fl_x must be a finite number"),
        ({"w": 0}, "must be above 0"),
        ({"w": 64}, r"an image of 32 x 16 px; the calibration is of 64 x 16 px"),
        ({"is_fisheye": True}, "cameras of is_fisheye are not read"),
        ({"camera_model": "opencv_fisheye"}, "the model 'opencv_fisheye' are not read"),
        ({"k5": 0.01}, "k5 is not read"),
        ({"timestamp": float("inf")}, "timestamp must be a finite number"),
    ],
)
def test_a_bad_entry_is_one_line(entry: dict, told: str, tmp_path: Path) -> None:
    made = frame("a", 0.0) | entry
    folder = write(tmp_path / "bad", [made])
    if "file_path" in entry and "none" in str(entry["file_path"]):
        (folder / "images" / "none.png").unlink()
    with pytest.raises(InputError, match=told) as refused:
        convert(folder, "nerfstudio", tmp_path / "out")
    assert "\n" not in str(refused.value)
    assert "bad" in str(refused.value)
    assert not list((tmp_path / "out").rglob("*.arrow"))


def turned(x: float, y: float, yaw_deg: float) -> list:
    """A camera at (x, y) that looks to the left of the world's x axis."""
    T = np.eye(4)
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], [x, y]
    return (T @ AHEAD).tolist()


MOUNTS = {"left": (0.2, 0.5, 60.0), "front": (0.5, 0.0, 0.0), "right": (0.2, -0.5, -60.0)}
"""Place (x, y) and yaw (degrees) of three cameras of one type on a vehicle."""


def rig_frames(name: str, late_s: float = 0.0, timed: bool = True) -> list[dict]:
    """Six times of three cameras on a vehicle that drives along x at 5 m/s and turns by 6 degrees a frame.

    The cameras after the first are late. `name` makes the path of an image of camera and number.
    """
    frames = []
    for k in range(6):
        for order, (camera, (x, y, yaw)) in enumerate(MOUNTS.items()):
            t_s = 0.1 * k + order * late_s
            heading = np.deg2rad(60 * t_s)
            c, s = np.cos(heading), np.sin(heading)
            place = (5 * t_s + c * x - s * y, s * x + c * y, yaw + np.rad2deg(heading))
            entry = {"file_path": name.format(camera=camera, k=8 + k), "transform_matrix": turned(*place)}
            frames.append(entry | ({"timestamp": 100.0 + t_s} if timed else {}))
    return frames


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize(
    "name",
    [
        "images/{camera}/{k}.png",
        "images/{camera}_{k}.png",
        "images/{k}-{camera}2.png",
        "images/cam0_{k}_{camera}.png",
    ],
)
def test_a_rig_of_one_type_of_cameras(name: str, timed: bool, tmp_path: Path) -> None:
    """Equal intrinsics do not make one camera: folders or names tell three apart, at constant places."""
    (path,) = convert(write(tmp_path / "rig", rig_frames(name, timed=timed)), "nerfstudio", tmp_path / "out")
    log = Log(path)
    assert np.diff(log.t_us).tolist() == [100_000] * 5
    cameras = pinhole_cameras(log)
    assert len(cameras) == 3
    assert read_notices(path.folder) == []
    left = np.linalg.inv(np.array(turned(*MOUNTS["left"]))) @ np.array(turned(*MOUNTS["front"]))
    for frame in range(6):
        shown = {
            name: read_camera(log, frame, camera, (16, 32), with_image=True)
            for name, camera in cameras.items()
        }
        assert all(camera.image is not None for camera in shown.values())
        by_name = {key: camera.T_ego_cam.double().numpy() for key, camera in shown.items()}
        first, second = (next(T for key, T in by_name.items() if side in key) for side in ("left", "front"))
        back = np.diag([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(np.linalg.inv(first) @ second, back @ left @ back, atol=1e-5)


def test_cameras_that_are_exposed_one_after_the_other(tmp_path: Path) -> None:
    """No two images have the same time. The places follow from the path between the images of one camera."""
    frames = rig_frames("images/{camera}/{k}.png", late_s=0.02)
    (path,) = convert(write(tmp_path / "rig", frames), "nerfstudio", tmp_path / "out")
    log = Log(path)
    assert np.diff(log.t_us).tolist() == [100_000] * 5
    cameras = pinhole_cameras(log)
    late = [
        read_camera(log, 2, camera, (16, 32), with_image=True).exposed_dt_s for camera in cameras.values()
    ]
    assert sorted(late) == pytest.approx([0.0, 0.02, 0.04])


@pytest.mark.parametrize(
    ("scale", "start_s"), [(1.0, 2.5), (1.0, 1.7e9), (1e3, 1.7e9), (1e6, 1.7e9), (1e9, 1.7e9)]
)
def test_stamps_since_1970_may_have_finer_units(scale: float, start_s: float, tmp_path: Path) -> None:
    stamps = [(start_s + 0.5 * k) * scale for k in range(3)]
    frames = [frame(str(k), float(k), timestamp=stamp) for k, stamp in enumerate(stamps)]
    (path,) = convert(write(tmp_path / "one", frames), "nerfstudio", tmp_path / "out")
    assert Log(path).t_us.tolist() == [round(start_s * 1e6) + 500_000 * k for k in range(3)]


def test_images_that_make_no_rig_are_refused(tmp_path: Path) -> None:
    """Equal numbers in three folders, whose cameras move against each other."""
    frames = rig_frames("images/{camera}/{k}.png", timed=False)
    for k, entry in enumerate(frames):
        if "left" in entry["file_path"]:
            entry["transform_matrix"] = turned(3.0 * k, 2.0 * k, 40.0 * k)
    folder = write(tmp_path / "rig", frames)
    with pytest.raises(InputError, match=r"cannot be split into cameras: by folder, .* no constant place"):
        convert(folder, "nerfstudio", tmp_path / "out")


def test_folders_of_a_split_are_no_cameras(tmp_path: Path) -> None:
    frames = [frame(f"{'train' if k % 2 else 'test'}/{k}", float(k)) for k in range(12)]
    (path,) = convert(write(tmp_path / "one", frames), "nerfstudio", tmp_path / "out")
    assert list(pinhole_cameras(Log(path))) == ["front"]


def test_numbers_in_names_are_sorted_by_their_values(tmp_path: Path) -> None:
    """As text, 10 comes before 2."""
    frames = [frame(str(k), float(k)) for k in (3, 10, 1, 11, 2)]
    (path,) = convert(write(tmp_path / "one", frames), "nerfstudio", tmp_path / "out")
    assert Log(path).T_world_ego[:, 0, 3].tolist() == pytest.approx([1.0, 2.0, 3.0, 10.0, 11.0], abs=1e-6)


def test_intrinsics_that_were_estimated_for_each_image(tmp_path: Path) -> None:
    frames = [frame(str(k), float(k)) | {"fl_x": 40.0 + 0.1 * k, "fl_y": 41.0 - 0.1 * k} for k in range(15)]
    (path,) = convert(write(tmp_path / "one", frames), "nerfstudio", tmp_path / "out")
    log = Log(path)
    assert len(log) == 15
    camera = read_camera(log, 0, pinhole_cameras(log)["front"], (16, 32), with_image=False)
    assert camera.K[0, 0].item() == pytest.approx(40.7)
    assert read_notices(path.folder) == [
        "front: calibrations differ a little between images; their median is used"
    ]


def test_one_damaged_image_costs_itself_alone(tmp_path: Path) -> None:
    folder = write(tmp_path / "one", [frame(str(k), float(k)) for k in range(3)])
    (folder / "images" / "1.png").write_bytes(b"not an image")
    (path,) = convert(folder, "nerfstudio", tmp_path / "out")
    log = Log(path)
    camera = pinhole_cameras(log)["front"]
    images = [read_camera(log, k, camera, (16, 32), with_image=True).image for k in range(3)]
    assert [image is None for image in images] == [False, True, False]
    (notice,) = read_notices(path.folder)
    assert notice.startswith("front: unreadable images, left out: 1 (images/1.png: ")


def test_thermal_images_are_scaled_by_one_stated_range(tmp_path: Path) -> None:
    folder = write(tmp_path / "one", [frame(str(k), float(k)) for k in range(2)])
    for k, values in enumerate(([7000, 8000], [8000, 9000])):
        pixels = np.repeat(np.array([values], np.uint16), 256, axis=0).reshape(16, 32)
        Image.fromarray(pixels).save(folder / "images" / f"{k}.png")
    (path,) = convert(folder, "nerfstudio", tmp_path / "out")
    log = Log(path)
    camera = pinhole_cameras(log)["front"]
    images = [read_camera(log, k, camera, (16, 32), with_image=True).image for k in range(2)]
    assert [image.float().mean().item() for image in images if image is not None] == pytest.approx(
        [64, 191], abs=3
    )
    told = "front: images of more than 8 bits; 7000 became 0 and 9000 became 255"
    assert read_notices(path.folder) == [told]


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    folder = write(tmp_path / "one", [frame("0", 0.0), frame("1", 1.0)])
    file = folder / "transforms.json"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    (path,) = convert(folder, "nerfstudio", tmp_path / "out")
    assert len(Log(path)) == 2


@pytest.mark.parametrize("spans", [(0.0, 1.0), (-1.0, 1.0), (0.0, 0.9)])
def test_normalised_times_become_a_tenth_of_a_second(spans: tuple[float, float], tmp_path: Path) -> None:
    """D-NeRF's `time` says nothing of seconds: the images are apart as those without times."""
    low, high = spans
    frames = rig_frames("images/{camera}/{k}.png", timed=False)
    for row, frame in enumerate(frames):
        frame["time"] = low + (high - low) * (row // 3) / 5
    (path,) = convert(write(tmp_path / "rig", frames), "nerfstudio", tmp_path / "out")
    log = Log(path)
    assert np.diff(log.t_us) == pytest.approx(np.full(5, 100_000), abs=1)
    assert log.speed_mps[2:] == pytest.approx(np.full(4, 5.0), rel=0.15)
    (told,) = read_notices(path.folder)
    assert f"entries `time` run from {low:g} to {high:g}, as normalised ones" in told


def test_times_that_end_at_exactly_one_are_told(tmp_path: Path) -> None:
    frames = rig_frames("images/{camera}/{k}.png", timed=False)
    for row, frame in enumerate(frames):
        frame["timestamp"] = (row // 3) / 5
    (path,) = convert(write(tmp_path / "rig", frames), "nerfstudio", tmp_path / "out")
    assert np.diff(Log(path).t_us).tolist() == [200_000] * 5
    assert "times from 0 to exactly 1 were read as seconds; normalised?" in read_notices(path.folder)[0]


def test_images_in_a_hole_of_the_first_cameras_path_are_left_out(tmp_path: Path) -> None:
    """The front camera has no images for 1.7 s in which the left one has two."""
    times_s = {"front": [0.0, 0.1, 0.2, 0.3, 2.0, 2.1, 2.2, 2.3], "left": [0.0, 0.3, 1.0, 1.5, 2.0, 2.3]}
    frames = []
    for camera, stamps in times_s.items():
        x, y, yaw = MOUNTS[camera]
        for k, t_s in enumerate(stamps):
            pose = turned(5 * t_s + x, y, yaw)
            path = f"images/{camera}/{k}.png"
            frames.append({"file_path": path, "transform_matrix": pose, "timestamp": 100.0 + t_s})
    (path,) = convert(write(tmp_path / "rig", frames), "nerfstudio", tmp_path / "out")
    log = Log(path)
    assert ((log.t_us - log.t_us[0]) * 1e-6).tolist() == pytest.approx(times_s["front"])
    assert log.speed_mps == pytest.approx(np.full(8, 5.0), rel=1e-3)
    told = (
        "frames: images of others between those of front more than 1 s apart, left out: 2 (101.000 s; 101.5"
    )
    assert any(line.startswith(told) for line in read_notices(path.folder))
