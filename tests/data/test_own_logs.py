"""Logs from arrays and files: what is written comes back through the readers of every other log."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from foredrive.data import Box, CameraSpec, LogPath, Points, Vehicle, find_logs, write_log
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.geometry.se3 import exp_se3
from foredrive.scene import Category

TIMES_S = np.array([100.0, 100.1, 100.2, 100.3])
TWIST = torch.tensor([8.0, 0.0, 0.0, 0.0, 0.0, 0.5], dtype=torch.float64)
"""8 m/s ahead and a turn of 0.5 rad/s."""
SIZE_HW = (24, 32)
CAMERA = CameraSpec(
    "front",
    np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]], np.float32),
    np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0.2], [0, -1, 0, 1.4], [0, 0, 0, 1]], np.float32),
    SIZE_HW,
)


def pose_at(t_s: float) -> np.ndarray:
    """A pose of the drive, which begins somewhere with some heading."""
    start = exp_se3(torch.tensor([30.0, -5.0, 1.0, 0.0, 0.0, 2.0], dtype=torch.float64))
    return (start @ exp_se3(TWIST * (t_s - TIMES_S[0]))).numpy()


POSES = np.stack([pose_at(t_s) for t_s in TIMES_S])


def write(tmp_path: Path, **given: object) -> Log:
    arguments: dict[str, object] = {"t_s": TIMES_S, "T_world_ego": POSES} | given
    write_log(tmp_path, "drive", **arguments)  # type: ignore[arg-type]
    return Log(find_logs(tmp_path)[0])


def test_the_vehicle_and_its_motion(tmp_path: Path) -> None:
    log = write(tmp_path, vehicle=Vehicle(length_m=5.0, width_m=2.0, height_m=1.6, axle_to_centre_m=1.5))
    np.testing.assert_array_equal(log.t_us, np.round(TIMES_S * 1e6))
    np.testing.assert_allclose(log.T_world_ego, POSES, atol=1e-9)
    centre, size = log.ego_box
    np.testing.assert_allclose(centre, [1.5, 0.0, 0.8])
    np.testing.assert_allclose(size, [5.0, 2.0, 1.6])
    np.testing.assert_allclose(log.speed_mps, 8.0, rtol=1e-3)  # a chord is shorter than its arc


def test_logs_overlap_where_name_and_time_are_common() -> None:
    def log(*parts: tuple[float, float], name: str = "split/a") -> LogPath:
        return LogPath(Path("root") / name, Path(), parts)

    early, late = log((0.0, 2.0), (4.0, 5.0)), log((2.0, 4.0))
    assert not early.overlaps(late)  # ends are exclusive
    assert early.overlaps(log((4.9, 9.0)))
    assert early.overlaps(log())  # the whole log
    assert log().overlaps(late)
    assert not log().overlaps(log(name="split/b"))


def test_cameras_keep_123d_names_in_any_case_and_others_go_by_direction(tmp_path: Path) -> None:
    names = ("ftcam_tele_f0", "PCAM_F0", "front")
    cameras = [dataclasses.replace(CAMERA, name=name) for name in names]
    images = {name: [np.zeros((*SIZE_HW, 3), np.uint8)] * len(TIMES_S) for name in names}
    log = write(tmp_path, cameras=cameras, images=images)
    ids = {name: camera.camera_id.name for name, camera in pinhole_cameras(log).items()}
    assert ids == {"ftcam_tele_f0": "FTCAM_TELE_F0", "PCAM_F0": "PCAM_F0", "front": "PCAM_STEREO_L"}
    twice = [dataclasses.replace(CAMERA, name=name) for name in ("pcam_f0", "PCAM_F0")]
    with pytest.raises(InputError, match="names are not unique"):
        write(tmp_path / "twice", cameras=twice)


def test_images_of_files_and_arrays_at_times_of_their_own(tmp_path: Path) -> None:
    image = np.full((*SIZE_HW, 3), (200, 100, 50), np.uint8)
    Image.fromarray(image).save(tmp_path / "front.png")
    log = write(
        tmp_path,
        cameras=[CAMERA],
        images={"front": [tmp_path / "front.png", image, None, image]},
        image_t_s={"front": TIMES_S + 0.03},
    )
    camera = pinhole_cameras(log)["front"]
    frames = [read_camera(log, frame, camera, SIZE_HW, with_image=True) for frame in range(4)]
    assert [frame.image is None for frame in frames] == [False, False, True, False]
    for frame in (0, 1):
        assert frames[frame].exposed_dt_s == pytest.approx(0.03)
        seen_from = pose_at(TIMES_S[frame] + 0.03) @ CAMERA.T_ego_cam
        expected = np.linalg.inv(pose_at(TIMES_S[frame])) @ seen_from
        np.testing.assert_allclose(frames[frame].T_ego_cam, expected, atol=6e-3)  # a chord for an arc
        shown = frames[frame].image
        assert shown is not None
        assert (shown.permute(1, 2, 0).int() - torch.tensor([200, 100, 50])).abs().max() < 6


@pytest.mark.parametrize("frame", [0, 2, 3])
def test_points_of_a_moving_vehicle_are_brought_to_the_time_of_the_frame(frame: int, tmp_path: Path) -> None:
    """A standing wall, measured over 80 ms while the vehicle turns: every point is where the wall is."""
    wall_world = POSES[frame, :3, :3] @ np.array([[10.0, y, 1.0] for y in np.linspace(-3, 3, 9)]).T
    wall_world = wall_world.T + POSES[frame, :3, 3]
    dt_s = np.linspace(-0.04, 0.04, 9)
    raw = []
    for point, dt in zip(wall_world, dt_s, strict=True):
        T = np.linalg.inv(pose_at(TIMES_S[frame] + dt))
        raw.append(T[:3, :3] @ point + T[:3, 3])
    points = Points(np.array(raw), np.linspace(0, 1, 9), dt_s, np.arange(9), compensated=False)
    sweeps = [points if each == frame else None for each in range(4)]
    log = write(tmp_path, sweeps=sweeps, lidar_position_m=(0.5, 0.0, 2.0))
    assert read_sweep(log, 1) is None
    found = read_sweep(log, frame)
    assert found is not None
    sweep, misses_known = found
    assert not misses_known
    expected = np.array([[10.0, y, 1.0] for y in np.linspace(-3, 3, 9)])
    np.testing.assert_allclose(sweep.points_ego.numpy(), expected, atol=6e-3)  # a chord for an arc
    np.testing.assert_allclose(sweep.dt_s.numpy(), dt_s, atol=1e-6)
    np.testing.assert_array_equal(sweep.beam.numpy(), np.arange(9))
    np.testing.assert_allclose(sweep.intensity.numpy(), np.linspace(0, 1, 9), atol=2e-3)
    lidar = np.linalg.inv(POSES[frame]) @ pose_at(TIMES_S[frame] + 0.04) @ [0.5, 0.0, 2.0, 1.0]
    np.testing.assert_allclose(sweep.origin_ego[-1].numpy(), lidar[:3], atol=0.012)


def test_boxes_where_the_log_is_labelled(tmp_path: Path) -> None:
    car = Box("vehicle.car", 7, (12.0, 3.0, 0.8), (4.0, 1.8, 1.5), 0.3, velocity_mps=(2.0, 0.5))
    walker = Box("Pedestrian", 9, (5.0, -4.0, 0.9), (0.6, 0.6, 1.8), -1.0)
    log = write(tmp_path, boxes=[[car, walker], None, [], [walker]])
    found = read_boxes(log, 0)
    assert found is not None
    assert found.category.tolist() == [Category.CAR, Category.PEDESTRIAN]
    np.testing.assert_allclose(found.centre, [car.centre_m, walker.centre_m], atol=1e-5)
    np.testing.assert_allclose(found.size_lwh, [car.size_lwh_m, walker.size_lwh_m], atol=1e-6)
    np.testing.assert_allclose(found.yaw, [0.3, -1.0], atol=1e-6)
    np.testing.assert_allclose(found.velocity[0], [2.0, 0.5], atol=1e-5)
    assert read_boxes(log, 1) is None
    nothing = read_boxes(log, 2)
    assert nothing is not None
    assert len(nothing.valid) == 0


IMAGE = np.zeros((*SIZE_HW, 3), np.uint8)
POINTS = Points(np.ones((5, 3)))
BOX = Box("car", 1, (1.0, 2.0, 0.5), (4.0, 2.0, 1.5), 0.0)


MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""Axes with y to the right: it is no rotation."""


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"t_s": TIMES_S[:3]}, r"t_s must be \[T\]"),
        ({"t_s": TIMES_S[::-1]}, "times must increase"),
        ({"T_world_ego": np.full((4, 4, 4), np.nan)}, "not finite"),
        ({"T_world_ego": POSES * 2}, "a matrix that is no rotation"),
        ({"T_world_ego": POSES * np.array([1.0, 1, 1, 2])[:, None]}, "the last row of each"),
        ({"sweeps": [POINTS]}, "1 entries in sweeps, but 4 frames"),
        ({"cameras": [CAMERA], "images": {"front": [IMAGE]}}, "1 entries in images of front"),
        ({"images": {"front": [IMAGE] * 4}}, "'front', which was not declared"),
        ({"cameras": [CAMERA], "images": {"front": [IMAGE[:5]] * 4}}, "image of front is"),
        ({"cameras": [CAMERA], "images": {"front": [IMAGE / 255] * 4}}, r"frame 0: an image must be uint8"),
        ({"cameras": [CAMERA], "images": {"front": ["nowhere.png"] * 4}}, "nowhere.png: cannot read"),
        ({"sweeps": [Points(np.ones((5, 2)))] * 4}, r"points must be \[N, 3\]"),
        ({"sweeps": [Points(np.full((5, 3), np.inf))] * 4}, "frame 0: a point is not finite"),
        ({"sweeps": [Points(np.ones((2, 3)), np.array([0.5, 80.0]))] * 4}, "intensity must be between"),
        ({"boxes": [[dataclasses.replace(BOX, category="Spaceship")]] * 4}, "unknown category 'Spaceship'"),
        ({"boxes": [[dataclasses.replace(BOX, yaw_rad=np.nan)]] * 4}, "box 1 is not finite"),
        ({"boxes": [[BOX, BOX]] * 4}, "two boxes have the same track_id"),
        ({"image_t_s": {"rear": TIMES_S}}, "times of 'rear', but there are no images"),
        (
            {"cameras": [CAMERA], "images": {"front": [IMAGE] * 4}, "image_t_s": {"front": TIMES_S * np.nan}},
            "a time of front in image_t_s is not finite",
        ),
        ({"split": "mine"}, "must be lower case and end in"),
        (
            {"cameras": [dataclasses.replace(CAMERA, K=CAMERA.K * np.nan)]},
            "the calibration of front is not finite",
        ),
        ({"cameras": [dataclasses.replace(CAMERA, K=-CAMERA.K)]}, "focal lengths of front must be above 0"),
        (
            {"cameras": [dataclasses.replace(CAMERA, T_ego_cam=MIRROR @ CAMERA.T_ego_cam)]},
            "T_ego_cam of front holds a matrix that is no rotation",
        ),
        (
            {"image_mounts": {"front": np.stack([CAMERA.T_ego_cam] * 3)}},
            "3 entries in mounts of front, but 4 frames",
        ),
        (
            {"image_mounts": {"front": np.stack([MIRROR @ CAMERA.T_ego_cam] * 4)}},
            "a mount of front is no rotation",
        ),
        (
            {"cameras": [dataclasses.replace(CAMERA, T_ego_cam=2 * CAMERA.T_ego_cam)]},
            "T_ego_cam of front holds a matrix that is no rotation",
        ),
        ({"t_s": TIMES_S + 1.7e18}, "times are in seconds; 1.7e"),
        (
            {"sweeps": [Points(np.ones((2, 3)), channel=np.array([0.5, 1.0]))] * 4},
            "channels must be whole numbers",
        ),
    ],
)
def test_bad_input_is_named_and_leaves_no_log(given: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        write(tmp_path, **given)
    assert not list(tmp_path.rglob("*.arrow"))


@pytest.mark.parametrize("name", ["", "..", "../drive", "a/b", "{tmp}/drive"])
def test_a_name_cannot_leave_the_folder_of_logs(name: str, tmp_path: Path) -> None:
    name = name.format(tmp=tmp_path)
    with pytest.raises(InputError, match="the name of a log has letters"):
        write_log(tmp_path / "data", name, TIMES_S, POSES)
    assert not list(tmp_path.rglob("*.arrow"))


def test_the_example_of_the_documentation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ten lines of docs/data.md write a log of the files that they name."""
    page = (Path(__file__).parents[2] / "docs" / "data.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    (example,) = (block for block in blocks if "write_log(" in block)
    monkeypatch.chdir(tmp_path)
    np.savez("calibration.npz", K=CAMERA.K, T_ego_cam=CAMERA.T_ego_cam)
    np.savez("poses.npz", t_s=TIMES_S, T_world_ego=POSES)
    for folder in ("front", "lidar"):
        Path(folder).mkdir()
    for frame in range(4):
        Image.new("RGB", (160, 90)).save(f"front/{frame:03d}.png")
        np.save(f"lidar/{frame:03d}.npy", np.full((10 + frame, 4), 5.0))
    exec(compile(example, "docs/data.md", "exec"), {})
    log = Log(find_logs(tmp_path / "data" / "logs" / "own_train" / "drive_1")[0])
    camera = pinhole_cameras(log)["front"]
    assert read_camera(log, 3, camera, (90, 160), with_image=True).image is not None
    found = read_sweep(log, 3)
    assert found is not None
    assert len(found[0].valid) == 13


def test_ten_minutes_of_poses_at_400_hz_keep_their_order(tmp_path: Path) -> None:
    """Doubles of seconds since 1970 are 0.24 µs apart; poses that are 1 µs beside a frame are other times."""
    t_us = np.int64(1_763_000_000_123_456) + 2500 * np.arange(240_000)
    frames_us = t_us[[40_001, 120_000, 239_998]] + 1
    path_us = np.union1d(t_us, frames_us)
    poses = np.tile(np.eye(4), (len(path_us), 1, 1))
    poses[:, 0, 3] = (path_us - t_us[0]) * 1e-5
    at_frames = poses[np.searchsorted(path_us, frames_us)]
    log = Log(write_log(tmp_path, "long", frames_us * 1e-6, at_frames, path=(path_us * 1e-6, poses)))
    assert log.t_us.tolist() == frames_us.tolist()
