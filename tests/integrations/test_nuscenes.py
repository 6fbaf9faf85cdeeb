"""Data sets in nuScenes' format: read by the published schema, and converted back into logs."""

import json
from pathlib import Path

import numpy as np
import pytest
import raw_nuscenes
import synthetic_log as world
import test_maps
from miniature import write_log
from nuscenes_files import Tables, matrix
from PIL import Image
from test_box_labels import written

from foredrive.cli.main import main
from foredrive.data import CameraSpec, LogPath, Points
from foredrive.data import write_log as write_own_log
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import encoded_image, pinhole_cameras, read_camera
from foredrive.data.formats.convert import convert
from foredrive.data.formats.nuscenes_names import NAME_OF_CATEGORY
from foredrive.data.lidar import read_sweep
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.data.maps import write_map
from foredrive.integrations.nuscenes.scene import _drawn
from foredrive.integrations.nuscenes.streams import lidar_axes
from foredrive.scene import Attribute, Category
from foredrive.tasks.objects.nuscenes_tables import read_tables_truth
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES

FRAMES = 21
"""Two seconds at 10 Hz: five samples."""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return write_log(tmp_path_factory.mktemp("log"), frames=FRAMES)


@pytest.fixture(scope="module")
def root(source: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("nuscenes")
    assert main(["export", "nuscenes", str(source.folder), "--out", str(out), "--workers", "1"]) == 0
    return out


@pytest.fixture(scope="module")
def tables(root: Path) -> Tables:
    return Tables(root)


def test_all_rows_are_linked(tables: Tables) -> None:
    assert len(tables.of) == 13
    every = [token for of in tables.of.values() for token in of]
    assert len(every) - len(tables.of["ego_pose"]) == len(
        set(every)
    )  # as in nuScenes, poses and readings share
    assert all(len(token) == 32 for table, of in tables.of.items() if table != "visibility" for token in of)
    for table, column, other in Tables.foreign:
        assert {row[column] for row in tables.rows(table)} <= set(tables.of[other]), (table, column)
    (drive,), (plan,) = tables.rows("log"), tables.rows("map")
    assert plan["log_tokens"] == [drive["token"]]


def test_samples_are_chained_at_two_hertz(tables: Tables) -> None:
    (scene,) = tables.rows("scene")
    samples = list(tables.chain("sample", scene["first_sample_token"]))
    assert len(samples) == scene["nbr_samples"] == len(tables.rows("sample"))
    assert samples[-1]["token"] == scene["last_sample_token"]
    assert [row["prev"] for row in samples] == ["", *(row["token"] for row in samples[:-1])]
    assert [row["timestamp"] for row in samples] == [world.START_US + 500_000 * k for k in range(5)]


@pytest.mark.parametrize("channel", ["CAM_FRONT", "CAM_FRONT_LEFT", "LIDAR_TOP"])
def test_readings_are_chained_and_belong_to_the_next_sample(tables: Tables, channel: str) -> None:
    """The devkit interpolates boxes of a reading between its sample and the one before."""
    readings = tables.readings(channel)
    assert list(tables.chain("sample_data", readings[0]["token"])) == readings
    assert [row["prev"] for row in readings] == ["", *(row["token"] for row in readings[:-1])]
    for k, row in enumerate(readings):
        sample = tables.of["sample"][row["sample_token"]]
        assert sample["timestamp"] == world.START_US + 500_000 * -(-k // 5)
        assert row["is_key_frame"] == (k % 5 == 0)
        assert row["filename"].startswith(f"{'samples' if k % 5 == 0 else 'sweeps'}/{channel}/")
        assert tables.of["ego_pose"][row["ego_pose_token"]]["timestamp"] == row["timestamp"]
        assert (tables.root / row["filename"]).is_file()


def test_points_lie_on_the_boxes_and_in_their_image(tables: Tables) -> None:
    """Through the tables alone: sensor, vehicle, global frame, box; and from there into the camera."""
    sweep, image = tables.readings("LIDAR_TOP")[10], tables.readings("CAM_FRONT")[10]
    rows, T = tables.points(sweep), tables.T_global_sensor(sweep)
    hits = rows[rows[:, 3] == 128]  # a quarter of the surface's number: the parked car is 2
    assert len(hits) > 20
    assert (hits[:, 1] > 3).all(), "y is ahead"
    assert (hits[:, 0] < 0).all(), "x is to the right, and the car is to the left"
    assert set(rows[:, 4].tolist()) == set(range(14))  # the two highest beams miss
    seen = hits[:, :3] @ T[:3, :3].T + T[:3, 3]
    (box,) = [
        row
        for row in tables.rows("sample_annotation")
        if row["sample_token"] == sweep["sample_token"]
        and np.allclose(row["size"], (2.0, 4.0, 2.0))
        and np.linalg.norm(seen.mean(0) - row["translation"]) < 3
    ]
    inside = (seen - box["translation"]) @ matrix(box)[:3, :3]
    np.testing.assert_allclose(np.abs(inside / [2.0, 1.0, 1.0]).max(-1), 1.0, atol=1e-4)
    assert 0 < box["num_lidar_pts"] <= len(hits)
    camera = tables.of["calibrated_sensor"][image["calibrated_sensor_token"]]
    T_cam = np.linalg.inv(tables.T_global_sensor(image))
    rays = (seen @ T_cam[:3, :3].T + T_cam[:3, 3]) @ np.array(camera["camera_intrinsic"]).T
    u, v = (rays[:, :2] / rays[:, 2:]).astype(int).T
    visible = (rays[:, 2] > 0) & (u >= 0) & (u < image["width"]) & (v >= 0) & (v < image["height"])
    pixels = np.asarray(Image.open(tables.root / image["filename"]))
    assert visible.sum() > 20
    error = np.abs(pixels[v[visible], u[visible]].astype(float) - world.PARKED_RGB).mean(-1)
    assert (error < 40).mean() > 0.9  # the ground differs by 77, the sky by 147


def test_our_own_reader_of_truth_takes_the_tables(tables: Tables, root: Path) -> None:
    listed = list(tables.of["sample"])
    truth = read_tables_truth(root / "v1.0-foredrive", listed, root, "tracking", DETECTION_CLASSES)
    speed = np.linalg.norm(truth.boxes.velocity, axis=-1)
    assert sorted(speed.round(6).tolist()) == [0.0] * 5 + [world.MOVING["speed"]] * 5
    assert {DETECTION_CLASSES[label] for label in truth.boxes.label} == {"car", "truck"}
    assert truth.boxes.num_points.min() > 0
    assert len(tables.of["instance"]) == 2


@pytest.mark.parametrize("dataset", ["nuscenes", "nuscenes-sweeps"])
def test_round_trip(source: LogPath, root: Path, tmp_path: Path, dataset: str) -> None:
    (path,) = convert(root, dataset, tmp_path)
    assert path.name == "nuscenes_flat_train/flat_train-flat"
    first, back = Log(source), Log(path)
    step = 5 if dataset == "nuscenes" else 1
    assert back.t_us.tolist() == first.t_us[::step].tolist()
    np.testing.assert_allclose(back.T_world_ego, first.T_world_ego[::step], atol=1e-9)
    for frame in range(0, FRAMES, 5):
        at = frame // step
        one, other = read_boxes(first, frame), read_boxes(back, at)
        assert one is not None
        assert other is not None
        for name in ("centre", "size_lwh", "yaw", "velocity"):
            np.testing.assert_allclose(getattr(other, name), getattr(one, name), atol=1e-5, err_msg=name)
        assert other.category.tolist() == one.category.tolist()
    for frame in range(0, FRAMES, step):
        _same_sensors(first, frame, back, frame // step)
    if step == 1:
        assert read_boxes(back, 1) is None, "nobody looked between the samples"


def _same_sensors(first: Log, frame: int, back: Log, at: int) -> None:
    before, after = read_sweep(first, frame), read_sweep(back, at)
    assert before is not None
    assert after is not None
    kept = before[0][before[0].returned]
    np.testing.assert_allclose(after[0].points_ego, kept.points_ego, atol=2e-5)
    np.testing.assert_allclose(after[0].origin_ego, kept.origin_ego, atol=1e-6)
    np.testing.assert_allclose(after[0].intensity, kept.intensity, atol=0.5 / 255 + 1e-6)
    assert after[0].beam.tolist() == kept.beam.tolist()
    theirs = {camera.camera_id: camera for camera in pinhole_cameras(back).values()}
    for camera in pinhole_cameras(first).values():
        other, size_hw = theirs[camera.camera_id], (camera.height, camera.width)
        assert encoded_image(back, at, other) == encoded_image(first, frame, camera)
        one = read_camera(first, frame, camera, size_hw, with_image=False)
        two = read_camera(back, at, other, size_hw, with_image=False)
        np.testing.assert_allclose(two.K, one.K, atol=1e-9)
        np.testing.assert_allclose(two.T_ego_cam, one.T_ego_cam, atol=1e-6)


def test_labels_of_boxes(tmp_path: Path) -> None:
    log = written(
        tmp_path / "data", [0.1, float("nan")], num_points=[17, 0], attribute=[Attribute.VEHICLE_PARKED, -1]
    )
    assert main(["export", "nuscenes", str(log.path.folder), "--out", str(tmp_path / "out")]) == 0
    tables = Tables(tmp_path / "out")
    parked, other = sorted(tables.rows("sample_annotation"), key=lambda row: -int(row["num_lidar_pts"]))
    assert (parked["num_lidar_pts"], other["num_lidar_pts"]) == (17, 0)
    (attribute,) = parked["attribute_tokens"]
    assert tables.of["attribute"][attribute]["name"] == "vehicle.parked"
    assert tables.of["visibility"][parked["visibility_token"]]["level"] == "v0-40"
    assert (other["attribute_tokens"], other["visibility_token"]) == ([], "")


def test_every_category_has_a_name_of_nuscenes() -> None:
    assert set(NAME_OF_CATEGORY) == set(Category)
    assert len(set(NAME_OF_CATEGORY.values())) == len(Category)
    assert NAME_OF_CATEGORY[Category.BUS] == "vehicle.bus.rigid"
    assert NAME_OF_CATEGORY[Category.OTHER] == "movable_object.debris"


@pytest.mark.parametrize("name", [pytest.param(n, id=f"x {n}") for n in ("ahead", "right", "down")])
def test_axes_of_the_lidar(name: str) -> None:
    """x to the right, y ahead, z up, whatever the log's axes; the mounting's own tilt stays."""
    mountings = {
        "ahead": [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]],
        "right": [[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]],
        "down": [[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    }
    tilt = np.array([[1.0, 0, 0], [0, np.cos(0.1), -np.sin(0.1)], [0, np.sin(0.1), np.cos(0.1)]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = tilt @ np.array(mountings[name]), (1.0, 0.2, 1.8)
    found = lidar_axes(T)
    np.testing.assert_allclose(found[:3, :3], tilt @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], T[:3, 3])


def test_lenses_are_undistorted(tmp_path: Path) -> None:
    """A pattern that is known in the plane ahead, seen through a lens, comes out as a pinhole sees it."""
    size_hw, K = (60, 90), np.array([[50.0, 0, 44.0], [0, 52.0, 31.0], [0, 0, 1]])
    dist = np.array([-0.2, 0.05, 0.002, -0.001, 0.0])
    v, u = np.meshgrid(np.arange(size_hw[0]) + 0.5, np.arange(size_hw[1]) + 0.5, indexing="ij")
    x_bent, y_bent = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    x, y = x_bent, y_bent
    for _ in range(50):
        r2 = x * x + y * y
        radial = 1 + dist[0] * r2 + dist[1] * r2**2
        x = (x_bent - 2 * dist[2] * x * y - dist[3] * (r2 + 2 * x * x)) / radial
        y = (y_bent - 2 * dist[3] * x * y - dist[2] * (r2 + 2 * y * y)) / radial

    def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        values = [128 + 90 * x, 128 + 120 * y, 128 + 60 * (x + y)]
        return np.stack(values, -1).clip(0, 255).round().astype(np.uint8)

    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    camera = CameraSpec("front", K, T, size_hw, dist=dist)
    log = write_own_log(
        tmp_path / "data",
        "lens",
        np.zeros(1),
        np.eye(4)[None],
        cameras=[camera],
        images={"front": [pattern(x, y)]},
    )
    assert main(["export", "nuscenes", str(log.folder), "--out", str(tmp_path / "out")]) == 0
    tables = Tables(tmp_path / "out")
    (reading,) = tables.rows("sample_data")
    calibrated = tables.of["calibrated_sensor"][reading["calibrated_sensor_token"]]
    np.testing.assert_allclose(calibrated["camera_intrinsic"], K)
    found = np.asarray(Image.open(tables.root / reading["filename"])).astype(float)
    expected = pattern(x_bent, y_bent).astype(float)
    seen = np.s_[8:-8, 8:-8]
    error = (found - expected)[seen]
    assert np.abs(error).mean() < 1
    assert (np.abs(error.mean((0, 1))) < 0.3).all()  # half a pixel is 0.9 in red, 1.2 in green


def test_the_mask_of_the_map(tmp_path: Path) -> None:
    """The devkit reads a pixel at x / 0.1 m and height - y / 0.1 m."""
    log = test_maps.write_with_map(tmp_path / "data")
    assert main(["export", "nuscenes", str(log.path.folder), "--out", str(tmp_path / "out")]) == 0
    tables = Tables(tmp_path / "out")
    (plan,), (drive,) = tables.rows("map"), tables.rows("log")
    mask = np.asarray(Image.open(tables.root / plan["filename"]))
    assert mask.dtype == np.uint8

    def at(x: float, y: float) -> int:
        return int(mask[round(len(mask) - y / 0.1), round(x / 0.1)])

    for pose in tables.rows("ego_pose"):
        x, y, _ = pose["translation"]
        assert [at(x, y + side) for side in (-2.2, -1.5, 0.0, 1.5, 2.2)] == [0, 255, 255, 255, 0]
        assert at(x + 80, y) == 255
    offset = np.subtract(log.T_world_ego[0, :2, 3], tables.rows("ego_pose")[0]["translation"][:2])
    np.testing.assert_allclose(offset, drive["world_offset_m"], atol=1e-9)
    np.testing.assert_allclose(offset, offset.round(), atol=1e-9)


def test_the_south_of_a_mask_is_its_last_row() -> None:
    strip = np.array([[100.0, 50, 0], [104, 50, 0], [104, 51, 0], [100, 51, 0]])  # 1 m along the south
    mask = _drawn([[strip]], np.array([100.0, 50.0]), np.array([40, 30]))
    assert mask.shape == (30, 40)
    assert (mask[-8:] == 255).all()
    assert not mask[:15].any()


def test_logs_that_share_a_map_share_its_frame(tmp_path: Path) -> None:
    maps_dir = write_map(test_maps.objects(), "Flatland", tmp_path)
    for name, first in (("one", 0), ("two", 40)):
        with LogWriter(tmp_path, "flat_train", name, [], maps_dir, "Flatland", None) as writer:
            for frame in range(first, first + 3):
                writer.write(world.frame(frame, []))
    assert main(["export", "nuscenes", str(tmp_path), "--out", str(tmp_path / "out"), "--workers", "1"]) == 0
    tables = Tables(tmp_path / "out")
    (plan,) = tables.rows("map")
    assert set(plan["log_tokens"]) == set(tables.of["log"])
    assert len(plan["log_tokens"]) == 2
    x = sorted(
        tables.of["ego_pose"][row["ego_pose_token"]]["translation"][0] for row in tables.rows("sample_data")
    )
    assert x[3] - x[0] == pytest.approx(4.0 * world.EGO_SPEED_MPS)
    mask = np.asarray(Image.open(tables.root / plan["filename"]))
    assert mask.any(axis=0).sum() == pytest.approx(2000, abs=2), "the whole lane of 200 m"


def test_without_a_map_nothing_is_drivable(tables: Tables) -> None:
    (plan,) = tables.rows("map")
    mask = np.asarray(Image.open(tables.root / plan["filename"]))
    assert not mask.any()
    where = np.array([pose["translation"][:2] for pose in tables.rows("ego_pose")]) / 0.1
    assert (where > 900).all()
    assert (where < np.array(mask.shape[::-1]) - 900).all(), "the devkit draws 57 m around a pose"


def test_each_reading_has_the_pose_of_its_own_time(tmp_path: Path) -> None:
    """Images are exposed 30 ms after the sweeps, at 10 m/s."""
    t_s = np.arange(11) * 0.1
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, 0, 3] = 10.0 * t_s
    K, image = np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), np.zeros((16, 16, 3), np.uint8)
    log = write_own_log(
        tmp_path / "data",
        "late",
        t_s,
        poses,
        cameras=[CameraSpec("front", K, np.eye(4), (16, 16))],
        images={"front": [image] * 11},
        image_t_s={"front": t_s + 0.03},
        sweeps=[Points(np.array([[5.0, 0.0, 0.0]]))] * 11,
        path=(np.arange(24) * 0.05, np.array([_ahead(0.5 * k) for k in range(24)])),
    )
    assert main(["export", "nuscenes", str(log.folder), "--out", str(tmp_path / "out")]) == 0
    tables = Tables(tmp_path / "out")
    start = tables.readings("LIDAR_TOP")[0]["timestamp"]
    for channel, late_s in (("LIDAR_TOP", 0.0), ("CAM_FRONT", 0.03)):
        for k, row in enumerate(tables.readings(channel)):
            after_s = (row["timestamp"] - start) * 1e-6
            assert after_s == pytest.approx(0.1 * k + late_s, abs=1e-5)
            pose = tables.of["ego_pose"][row["ego_pose_token"]]
            driven = pose["translation"][0] + tables.rows("log")[0]["world_offset_m"][0]
            assert driven == pytest.approx(10.0 * after_s, abs=1e-4)


def _ahead(x_m: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def test_samples_lack_no_sensor(tmp_path: Path) -> None:
    """Frames 0 and 5 have no image; frames 10 to 12 have no sweep."""
    t_s, poses = np.arange(20) * 0.1, np.tile(np.eye(4), (20, 1, 1))
    image, points = np.zeros((16, 16, 3), np.uint8), Points(np.array([[5.0, 0.0, 0.0]]))
    K, T = np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), np.eye(4)
    log = write_own_log(
        tmp_path / "data",
        "gaps",
        t_s,
        poses,
        cameras=[CameraSpec("front", K, T, (16, 16))],
        images={"front": [None if k in (0, 5) else image for k in range(20)]},
        sweeps=[None if k in (10, 11, 12) else points for k in range(20)],
    )
    assert main(["export", "nuscenes", str(log.folder), "--out", str(tmp_path / "out")]) == 0
    tables = Tables(tmp_path / "out")
    start = Log(log).t_us[0]
    at = [(row["timestamp"] - start) // 100_000 for row in tables.rows("sample")]
    assert at == [1, 6, 13, 18]
    for channel, lacking in (("CAM_FRONT", {0, 5}), ("LIDAR_TOP", {10, 11, 12})):
        readings = tables.readings(channel)
        times = [(row["timestamp"] - start) // 100_000 for row in readings]
        assert times == [k for k in range(20) if k not in lacking]
        assert [time for time, row in zip(times, readings, strict=True) if row["is_key_frame"]] == at


def test_a_data_set_in_nuscenes_format_comes_out_as_it_came_in(tmp_path: Path) -> None:
    """Sweeps at 20 Hz and images at 2 Hz, each of which is beside several sweeps: it is written once."""
    raw_nuscenes.write(tmp_path / "raw", "v1.0-own")
    (log,) = convert(tmp_path / "raw", "nuscenes-sweeps", tmp_path / "data")
    assert main(["export", "nuscenes", str(log.folder), "--out", str(tmp_path / "out")]) == 0
    before, after = Tables(tmp_path / "raw", "v1.0-own"), Tables(tmp_path / "out")
    for channel in ("LIDAR_TOP", *raw_nuscenes.CAMERAS):
        one, other = before.readings(channel), after.readings(channel)
        for column in ("timestamp", "is_key_frame", "height", "width"):
            assert [row[column] for row in other] == [row[column] for row in one], (channel, column)
        for old, new in zip(one, other, strict=True):
            files = [root.root / row["filename"] for root, row in ((before, old), (after, new))]
            if channel != "LIDAR_TOP":
                assert files[1].read_bytes() == files[0].read_bytes()
            else:  # x ahead there
                x, y, z, intensity, ring = before.points(old).T
                np.testing.assert_allclose(after.points(new).T, [-y, x, z, intensity, ring], atol=1e-5)
    annotations = [
        sorted(each.rows("sample_annotation"), key=lambda row: row["next"] == "") for each in (before, after)
    ]
    offset = [*after.rows("log")[0]["world_offset_m"], 0.0]
    for old, new in zip(*annotations, strict=True):
        assert new["size"] == pytest.approx(old["size"])
        assert np.add(new["translation"], offset) == pytest.approx(old["translation"])
        assert new["num_lidar_pts"] == old["num_lidar_pts"]
        assert new["visibility_token"] == old["visibility_token"]
        assert (new["prev"] == "", new["next"] == "") == (old["prev"] == "", old["next"] == "")


def test_the_same_log_gives_the_same_bytes(source: LogPath, root: Path, tmp_path: Path) -> None:
    assert main(["export", "nuscenes", str(source.folder), "--out", str(tmp_path)]) == 0
    files = [path.relative_to(root) for path in root.rglob("*") if path.is_file()]
    assert len(files) > 60
    for file in files:
        assert (tmp_path / file).read_bytes() == (root / file).read_bytes(), file


def test_key_frames_alone_at_another_rate(source: LogPath, tmp_path: Path) -> None:
    flags = ["--rate", "5", "--no-sweeps", "--name", "mini", "--out", str(tmp_path)]
    assert main(["export", "nuscenes", str(source.folder), *flags]) == 0
    tables = Tables(tmp_path, "v1.0-mini")
    assert len(tables.rows("sample")) == 11
    assert all(row["is_key_frame"] for row in tables.rows("sample_data"))
    assert not (tmp_path / "sweeps").exists()
    assert json.loads((tmp_path / "v1.0-mini" / "splits.json").read_text()) == {
        "flat_train": ["flat_train-flat"]
    }
