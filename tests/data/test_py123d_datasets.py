"""Data sets that py123d parses: made trees of their published files convert, each through its own parser."""

import importlib.util
import io
import json
import pickle
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import raw_av2
import raw_kitti360
import raw_nuscenes
import raw_waymo
from PIL import Image
from plyfile import PlyData, PlyElement
from py123d.datatypes import CameraID
from py123d.parser.nureasoning.utils import nureasoning_schema as nureasoning
from py123d.parser.truckdrive.truckdrive_constants import LABEL_MAPPING, MAPPED_CATEGORIES
from scipy.spatial.transform import Rotation
from test_raw_pandaset import Intruder

from foredrive.cli.convert import convert as convert_verb
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.formats.convert import DATASETS, convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.maps import read_map_patch
from foredrive.data.notices import read_notices
from foredrive.data.safe_pickle import PlainPickle
from foredrive.errors import InputError
from foredrive.runs.convert import convert_all
from foredrive.scene import Attribute, Category, MapKind, Visibility
from foredrive.scene.boxes import UNKNOWN

HAS_NUSCENES = importlib.util.find_spec("nuscenes") is not None
NEEDS_DEVKIT = pytest.mark.skipif(not HAS_NUSCENES, reason="nuscenes-devkit is not installed")
HAS_TENSORFLOW = importlib.util.find_spec("tensorflow") is not None


@pytest.fixture
def kitti360(tmp_path: Path) -> Path:
    raw_kitti360.write(tmp_path / "raw")
    return tmp_path / "raw"


def test_kitti_360(kitti360: Path, tmp_path: Path) -> None:
    (path,) = convert(kitti360, "kitti360", tmp_path / "out")
    assert path.name == f"kitti360_train/{raw_kitti360.DRIVE}"
    log = Log(path)
    assert np.diff(log.T_world_ego[:, :3, 3], axis=0) == pytest.approx(np.array([[1.0, 0, 0]] * 2))
    sweep = read_sweep(log, 1)
    assert sweep is not None
    # the ego's axle is 0.05 m ahead and 0.32 m right of the IMU, and 0.9 m below it
    assert sweep[0].points_ego[0].tolist() == pytest.approx([9.95, 2.32, -0.1], abs=1e-5)
    boxes = read_boxes(log, 1)
    assert boxes is not None
    by_x = boxes.centre[:, 0].argsort()
    assert boxes.centre[by_x, 0].tolist() == pytest.approx([9.95, 18.95], abs=1e-4)
    assert boxes.size_lwh[by_x[0]].tolist() == pytest.approx([4.0, 2.0, 1.6])
    cameras = pinhole_cameras(log)
    image = read_camera(log, 0, cameras["image_00"], (16, 32), with_image=True).image
    assert image is not None
    assert image.float().mean((1, 2)).tolist() == pytest.approx([10, 200, 30], abs=2)
    assert len(read_map_patch(log, 0).kind)
    assert not list(kitti360.rglob("*.pkl")), "the raw data set was written to"


def test_precomputed_boxes_of_kitti_360_are_not_unpickled(kitti360: Path, tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    for folder in (kitti360, kitti360 / "preprocessed_detections"):
        folder.mkdir(exist_ok=True)
        file = folder / f"{raw_kitti360.DRIVE}_detection_preprocessed.pkl"
        file.write_bytes(pickle.dumps({"static": [Intruder(f"touch {ran}")]}))
    assert convert(kitti360, "kitti360", tmp_path / "out")
    assert not ran.exists()


def test_a_pickle_in_a_library_stays_plain() -> None:
    plain = PlainPickle([("collections", "OrderedDict")])
    for value in ({"a": np.arange(3.0)}, [1, "x", None]):
        assert repr(plain.loads(pickle.dumps(value))) == repr(value)
    with pytest.raises(pickle.UnpicklingError, match=r"posix\.system"):
        plain.load(io.BytesIO(pickle.dumps(Intruder("true"))))


def write_griffin(folder: Path) -> None:
    """The 27th scene, which is one of the published train split, with two frames 2 m apart."""
    side = folder / "griffin_50scenes_25m" / "griffin-release" / "vehicle-side"
    names = [f"none-{k}" for k in range(26)] + ["Town07-001"]
    frames = ["000010", "000011"]
    scenes = [{"name": name, "info": {"frames": frames if name == "Town07-001" else []}} for name in names]
    for kind in ("calib", "pose", "label", "lidar/lidar_top", "camera/front"):
        (side / kind).mkdir(parents=True)
    (side / "scene_infos.json").write_text(json.dumps(scenes))
    K, T = [[960, 0, 960], [0, 960, 540], [0, 0, 1]], np.eye(4)
    T[:3] = [[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6]]
    for camera in ("front", "back", "left", "right"):
        (side / "calib" / f"{camera}.json").write_text(json.dumps({"intrinsic": K, "extrinsic": T.tolist()}))
    (side / "calib" / "lidar_top.json").write_text(json.dumps({"extrinsic": np.eye(4).tolist()}))
    for k, frame in enumerate(frames):
        pose = {"x": 2.0 * k, "y": 0.0, "z": 0.0, "roll": 0.0, "pitch": 0.0, "yaw": 0.0}
        (side / "pose" / f"{frame}.json").write_text(json.dumps(pose))
        (side / "label" / f"{frame}.txt").write_text(f"car {10 - 2 * k} 3 0.8 4.2 1.8 1.5 0 0 90 7 1.0\n")
        points = np.array([(5.0, 1.0, 0.0, 0.5)], [(name, "f4") for name in "xyzI"])
        PlyData([PlyElement.describe(points, "vertex")]).write(side / "lidar/lidar_top" / f"{frame}.ply")
        Image.new("RGB", (1920, 1080)).save(side / "camera/front" / f"{frame}.png")


def test_griffin(tmp_path: Path) -> None:
    write_griffin(tmp_path / "raw")
    there = tmp_path / "out" / "maps" / "griffin" / "griffin_Town07.arrow"
    there.parent.mkdir(parents=True)
    there.touch()  # the map of the town takes seconds, and is shared
    (path,) = convert(tmp_path / "raw", "griffin", tmp_path / "out")
    assert path.name == "griffin_50scenes_25m_train/scene-0026-Town07-001"
    log = Log(path)
    assert np.diff(log.t_us).tolist() == [100_000]
    assert log.speed_mps[1] == pytest.approx(20.0)
    boxes = read_boxes(log, 1)
    assert boxes is not None
    assert boxes.centre[0, :2].tolist() == pytest.approx([8.0, 3.0], abs=1e-5)
    assert boxes.yaw[0].item() == pytest.approx(np.pi / 2, abs=1e-5)
    assert there.stat().st_size == 0


def write_truckdrive(folder: Path) -> None:
    """A scene of two frames 3 m apart: one lidar, one box in the frame of the Velodyne."""
    scene = folder / "scene_900_1"
    frames = ("lidar_aeva_forward_center_wide", "velodyne")
    turn = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
    moved = {"translation": {"x": 4.0, "y": 0.0, "z": 2.0}, "rotation": turn}
    tree = {
        name: {"header": {"frame_id": "vehicle"}, "child_frame_id": name, "transform": moved}
        for name in frames
    }
    points = scene / "lidar" / "aeva" / "joint_lidars" / "points"
    boxes = scene / "annotations" / "bounding_boxes"
    for made in (scene / "calibrations", scene / "poses", points, boxes):
        made.mkdir(parents=True)
    (scene / "calibrations" / "calib_tf_tree_full.json").write_text(json.dumps(tree))
    rows = "".join(f"{k} {1000 + 0.1 * k} {3.0 * k} 0 0 0 0 0 1\n" for k in range(2))
    (scene / "poses" / "gt_trajectory.txt").write_text("key t x y z qx qy qz qw\n" + rows)
    for k in range(2):
        np.array([[6.0, 1.0, 0.0, 40.0, *[0.0] * 7]]).tofile(points / f"{k}_{1000 + k}.bin")
        box = {"class-id": CAR, "x": 20.0, "y": 1.0, "z": 0.0, "l": 4.0, "w": 2.0, "h": 1.5, "yaw": 0.0}
        (boxes / f"{k}_{1000 + k}.json").write_text(json.dumps([box | {"Tracking_ID": 5}]))


CAR = next(name for name, number in LABEL_MAPPING.items() if number == MAPPED_CATEGORIES["Passenger-Car"])


def test_truckdrive_leaves_unknown_speeds_out(tmp_path: Path) -> None:
    """py123d writes 0 m/s for the vehicle and the boxes; here the speed follows from the poses."""
    write_truckdrive(tmp_path / "raw")
    (path,) = convert(tmp_path / "raw", "truckdrive", tmp_path / "out")
    assert path.name == "truckdrive_train/scene_900_1"
    log = Log(path)
    assert log.speed_mps[1] == pytest.approx(30.0)
    boxes = read_boxes(log, 1)
    assert boxes is not None
    assert boxes.centre[0, 0].item() == pytest.approx(24.0, abs=1e-4)
    assert boxes.velocity[0, 0].item() == pytest.approx(30.0, abs=0.1)


@NEEDS_DEVKIT
def test_nuscenes_at_key_frames_and_with_sweeps(tmp_path: Path) -> None:
    raw_nuscenes.write(tmp_path / "raw")
    (path,) = convert(tmp_path / "raw", "nuscenes", tmp_path / "out")
    assert path.name == f"nuscenes-mini_val/{raw_nuscenes.SCENE}"
    log = Log(path)
    assert (log.t_us - raw_nuscenes.START_US).tolist() == [0, 500_000]
    # without a CAN bus the speed is not 0: it follows from the poses
    assert log.speed_mps[1] == pytest.approx(4.0)
    boxes = read_boxes(log, 1)
    assert boxes is not None
    assert boxes.centre[0].tolist() == pytest.approx([9.0, 2.0, 0.8])
    (path,) = convert(tmp_path / "raw", "nuscenes-sweeps", tmp_path / "out")
    assert path.name == f"nuscenes-interpolated-mini_val/{raw_nuscenes.SCENE}"
    log = Log(path)
    assert np.diff(log.t_us).tolist() == [100_000] * 5
    boxes = read_boxes(log, 2)
    assert boxes is not None  # 0.2 s after the key frame: 10 + 2 · 0.2 − 4 · 0.2
    assert boxes.centre[0, 0].item() == pytest.approx(9.6, abs=1e-4)
    sweep = read_sweep(log, 2)
    assert sweep is not None
    assert sweep[0].points_ego[0].tolist() == pytest.approx([6.0, 1.0, 0.8], abs=1e-5)


def test_own_scenes_in_nuscenes_format_need_no_devkit(tmp_path: Path) -> None:
    """The same tree by our own parser: all is read as it is, and frames between samples have no boxes."""
    raw_nuscenes.write(tmp_path / "raw", "v1.0-own")
    (path,) = convert(tmp_path / "raw", "nuscenes", tmp_path / "out")
    assert path.name == f"nuscenes_train/{raw_nuscenes.SCENE}"
    log = Log(path)
    assert (log.t_us - raw_nuscenes.START_US).tolist() == [0, 500_000]
    assert len(pinhole_cameras(log)) == 6
    boxes = read_boxes(log, 1)
    assert boxes is not None
    assert boxes.centre[0].tolist() == pytest.approx([9.0, 2.0, 0.8])
    assert boxes.velocity[0].tolist() == pytest.approx([2.0, 0.0])
    assert (boxes.num_points.item(), boxes.attribute.item()) == (5, Attribute.VEHICLE_MOVING)
    assert boxes.visibility.item() == Visibility.V80_100
    (path,) = convert(tmp_path / "raw", "nuscenes-sweeps", tmp_path / "ten")
    log = Log(path)
    assert np.diff(log.t_us).tolist() == [50_000] * 10
    assert read_boxes(log, 4) is None
    sweep = read_sweep(log, 4)
    assert sweep is not None
    assert sweep[0].points_ego[0].tolist() == pytest.approx([6.0, 1.0, 0.8], abs=1e-5)
    assert len(log.rows("camera.pcam_f0")[0]) == 4  # an image is beside the sweeps 50 ms before and after


def changed(table: Path, change: Callable[[dict[str, Any]], dict[str, Any] | None]) -> None:
    """Replace each row of a table by what `change` makes of it; None leaves it out."""
    rows = [change(row) for row in json.loads(table.read_bytes())]
    text = json.dumps([row for row in rows if row is not None])
    table.write_bytes(b"\xef\xbb\xbf" + text.encode())  # some programs begin with a byte order mark


def test_own_scenes_may_lack_the_lidar_and_most_columns(tmp_path: Path) -> None:
    """Names as of Lyft, no sizes of images, no visibilities, a camera that looks back to the left."""
    tables = tmp_path / "raw" / "v1.02-own"
    raw_nuscenes.write(tmp_path / "raw", tables.name)
    changed(
        tables / "sample_data.json", lambda row: None if "LIDAR" in row["token"] else row | {"width": None}
    )
    missing = ("visibility_token", "attribute_tokens", "num_lidar_pts")
    changed(
        tables / "sample_annotation.json",
        lambda row: {key: value for key, value in row.items() if key not in missing},
    )
    for name in ("visibility", "attribute"):
        (tables / f"{name}.json").unlink()
    changed(tables / "category.json", lambda row: row | {"name": "Pedestrian"})
    names = {"CAM_BACK_LEFT": "rear-left"}
    changed(tables / "sensor.json", lambda row: row | {"channel": names.get(row["channel"], row["channel"])})
    turned = Rotation.from_euler("z", 120, degrees=True) * Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])
    back_left = {"rotation": np.roll(turned.as_quat(), 1).tolist()}
    changed(
        tables / "calibrated_sensor.json",
        lambda row: row | (back_left if row["token"] == "cal-CAM_BACK_LEFT" else {}),
    )
    (path,) = convert(tmp_path / "raw", "nuscenes", tmp_path / "out")
    log = Log(path)
    cameras = pinhole_cameras(log)
    assert cameras["rear-left"].camera_id == CameraID.PCAM_L1
    assert (cameras["rear-left"].width, cameras["rear-left"].height) == (32, 16)
    assert len(cameras) == 6
    assert read_sweep(log, 0) is None
    boxes = read_boxes(log, 0)
    assert boxes is not None
    assert boxes.category.tolist() == [Category.PEDESTRIAN]
    assert (boxes.num_points.item(), boxes.attribute.item(), boxes.visibility.item()) == (UNKNOWN,) * 3
    assert read_notices(path.folder) == []


def test_unknown_classes_of_own_scenes_are_counted(tmp_path: Path) -> None:
    raw_nuscenes.write(tmp_path / "raw", "v1.0-own")
    changed(tmp_path / "raw" / "v1.0-own" / "category.json", lambda row: row | {"name": "hovercraft"})
    (path,) = convert(tmp_path / "raw", "nuscenes", tmp_path / "out")
    told = "sample_annotation: boxes of unknown classes, read as OTHER: 2 ('hovercraft'; 'hovercraft')"
    assert read_notices(path.folder) == [told]


def test_a_damaged_sensor_file_costs_itself_alone(tmp_path: Path) -> None:
    """Of three streams of a scene: a cut JPEG, a missing image, and a sweep with half a point."""
    raw_nuscenes.write(tmp_path / "raw", "v1.0-own")
    samples = tmp_path / "raw" / "samples"
    cut = samples / "CAM_FRONT" / "CAM_FRONT-0.jpg"
    cut.write_bytes(cut.read_bytes()[:-200])
    (samples / "CAM_BACK" / "CAM_BACK-500000.jpg").unlink()
    sweep = samples / "LIDAR_TOP" / "LIDAR_TOP-500000.pcd.bin"
    sweep.write_bytes(sweep.read_bytes()[:30])
    (path,) = convert(tmp_path / "raw", "nuscenes", tmp_path / "out")
    log = Log(path)
    assert log.rows("camera.pcam_f0")[0].tolist() == [1]
    assert log.rows("camera.pcam_b0")[0].tolist() == [0]
    assert log.rows("camera.pcam_l0")[0].tolist() == [0, 1]
    assert [read_sweep(log, frame) is None for frame in range(2)] == [False, True]
    lidar, front, back = sorted(read_notices(path.folder), key=lambda line: "CAM" in line)
    assert "lidar: unreadable sweeps, left out: 1 (samples/LIDAR_TOP/LIDAR_TOP-500000.pcd.bin: " in lidar
    assert "CAM_FRONT: unreadable images, left out: 1 (samples/CAM_FRONT/CAM_FRONT-0.jpg: " in front
    assert "CAM_BACK: unreadable images, left out: 1 (samples/CAM_BACK/CAM_BACK-500000.jpg: " in back


def test_sweeps_of_four_columns_in_nuscenes_format_are_refused(tmp_path: Path) -> None:
    """Twenty numbers are five rows of four columns, and four of five."""
    raw_nuscenes.write(tmp_path / "raw", "v1.0-own")
    for file in (tmp_path / "raw").rglob("*.pcd.bin"):
        np.array([[5, -1, -1, 20], [8, 0.5, 0, 30]] * 10, np.float32).tofile(file)
    with pytest.raises(InputError, match=r"none of its sweeps can be read.*4 columns would fit"):
        convert(tmp_path / "raw", "nuscenes", tmp_path / "out")


@pytest.mark.parametrize("cameras", [False, True])
def test_an_argoverse_log_of_the_test_split_has_no_boxes(cameras: bool, tmp_path: Path) -> None:
    """Two sweeps, no annotations; the boxes are unknown, which is not the same as none."""
    folder = tmp_path / "raw" / "test" / "0-1"
    raw_av2.write(folder, cameras=cameras)
    (path,) = convert(tmp_path / "raw", "av2", tmp_path / "out")
    assert path.name == "av2-sensor_test/0-1"
    log = Log(path)
    assert np.diff(log.t_us).tolist() == [100_000]
    assert read_boxes(log, 0) is None
    sweep = read_sweep(log, 1)
    assert sweep is not None
    assert sweep[0].points_ego[:, 0].tolist() == pytest.approx([11.0, 21.0], abs=0.05)
    assert len(pinhole_cameras(log)) == (2 if cameras else 0)


@pytest.mark.parametrize("version", [pytest.param("v1.0-mini", marks=NEEDS_DEVKIT), "v1.0-own"])
def test_a_table_cannot_name_files_outside_of_nuscenes(version: str, tmp_path: Path) -> None:
    raw_nuscenes.write(tmp_path / "raw", version)
    table = tmp_path / "raw" / version / "sample_data.json"
    table.write_text(table.read_text().replace("samples/CAM_FRONT/", "../secret/"))
    (tmp_path / "secret").mkdir()
    for image in (tmp_path / "raw" / "samples" / "CAM_FRONT").iterdir():
        image.rename(tmp_path / "secret" / image.name)
    with pytest.raises(InputError, match="outside of the data set"):
        convert(tmp_path / "raw", "nuscenes", tmp_path / "out")


@pytest.mark.skipif(not HAS_TENSORFLOW, reason="tensorflow is not installed")
def test_waymo_perception(tmp_path: Path) -> None:
    raw_waymo.write_perception(tmp_path / "raw")
    (path,) = convert(tmp_path / "raw", "waymo", tmp_path / "out")
    assert path.name == "wod-perception_train/1_2_3"
    log = Log(path)
    assert np.diff(log.T_world_ego[:, :3, 3], axis=0) == pytest.approx(np.array([[1.0, 0, 0]]))
    sweep = read_sweep(log, 0)
    assert sweep is not None
    assert sweep[0].points_ego.norm(dim=-1).tolist() == pytest.approx([10.0] * 4, abs=0.1)
    boxes = read_boxes(log, 0)
    assert boxes is not None
    assert boxes.centre[0].tolist() == pytest.approx([10.0, 2.0, 0.8], abs=1e-4)


@pytest.mark.skipif(not HAS_TENSORFLOW, reason="tensorflow is not installed")
def test_waymo_motion(tmp_path: Path) -> None:
    raw_waymo.write_motion(tmp_path / "raw")
    (path,) = convert(tmp_path / "raw", "waymo-motion", tmp_path / "out")
    assert path.name == "wod-motion_val/abc"
    log = Log(path)
    assert len(log) == 3
    boxes = read_boxes(log, 1)
    assert boxes is not None
    assert len(boxes.centre) == 1


def write_nureasoning(folder: Path) -> Path:
    """Three frames of a turning car with a camera, a sweep, a box and a lane, by nuReasoning's schema."""
    clip = folder / "train" / "part_1" / "2025.01.01_drive_abc"
    for name in ("cameras/CAM_M_F", "lidar", "ego_state", "annotations"):
        (clip / name).mkdir(parents=True)
    frames = []
    for k in range(3):
        t_us, yaw = 1_000_000 + 100_000 * k, 0.5 + 0.1 * k
        x, y = 100.0 + k, 50.0 + 0.5 * k
        turn = dict(zip(("qx", "qy", "qz", "qw"), Rotation.from_euler("z", yaw).as_quat(), strict=True))
        pose = {"x": x, "y": y, "z": 2.35, "yaw": yaw} | {key: float(value) for key, value in turn.items()}
        still = {"ax": 0.0, "ay": 0.0, "az": 0.0}
        ego = nureasoning.EgoState(pose, {"vx": 9.0, "vy": 0.0, "vz": 0.0}, still)
        car = nureasoning.ObjectAnnotation(
            "t1", "vehicle.truck", {"x": 120.0, "y": 50.0, "z": 3.0, "yaw": 1.5},
            {"vx": 0.0, "vy": 4.0, "vz": 0.0}, {"l": 6.0, "w": 2.5, "h": 3.0},
        )  # fmt: skip
        light = nureasoning.TrafficLightState(1, "red", lane_connector_id=7)
        dump_as_published(clip / f"ego_state/{t_us}.pkl", ego)
        dump_as_published(clip / f"annotations/{t_us}.pkl", nureasoning.Annotations([car], [light]))
        Image.new("RGB", (64, 48), (200, 100, 50)).save(clip / f"cameras/CAM_M_F/CAM_M_F_{t_us}.jpg")
        types = [(name, "<f4") for name in ("x", "y", "z", "intensity")] + [
            ("lidar_info", "u1"),
            ("ring", "u1"),
        ]
        points = np.array([(10, 2, -0.35, 51, 0, 3), (0, 0, 0, 5, 1, 4)], dtype=types)
        sizes = "SIZE 4 4 4 4 1 1\nTYPE F F F F U U\nPOINTS 2\nDATA binary\n"
        header = f"FIELDS {' '.join(name for name, _ in types)}\n{sizes}"
        (clip / f"lidar/{t_us}.pcd").write_bytes(header.encode() + points.tobytes())
        frames.append(
            {
                "timestamp_us": t_us,
                "ego_state": f"ego_state/{t_us}.pkl",
                "annotations": f"annotations/{t_us}.pkl",
                "reasoning": "",
                "sensors": {
                    "cameras": {"front": f"cameras/CAM_M_F/CAM_M_F_{t_us}.jpg"},
                    "lidar": {"point_cloud_path": f"lidar/{t_us}.pcd"},
                },
            }
        )
    lens = {
        "intrinsic": [[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]],
        "sensor2lidar_translation": [1.5, 0.1, 1.2],
        "sensor2lidar_rotation": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
        "width": 64,
        "height": 48,
    }
    size = {"length": 4.6, "width": 1.9, "height": 1.6, "vehicle_rear_length": 0.9}
    metadata = {
        "clip_location": "las vegas",
        "ego_dimensions": size,
        "camera_calibrations": {"CAM_M_F": lens},
    }
    (clip / "metadata.json").write_text(json.dumps(metadata | {"frames": frames}))
    ring = [[90.0, 48, 0], [140, 48, 0], [140, 52, 0], [90, 52, 0], [90, 48, 0]]
    lane = nureasoning.Lane(5, 0, ring, 1, 0, 13.9, [[90.0, 50, 0], [115, 50, 0], [140, 50, 0]])
    dump_as_published(clip / "map.pkl", nureasoning.nuReasoningStaticMap(lanes=[lane]))
    return clip


def dump_as_published(file: Path, record: Any) -> None:
    """Pickle a record as the published files name its class: of a module data_schema."""
    data = pickle.dumps(record, protocol=2)
    file.write_bytes(data.replace(nureasoning.__name__.encode(), b"data_schema"))


def test_nureasoning(tmp_path: Path) -> None:
    clip = write_nureasoning(tmp_path / "raw")
    (path,) = convert(tmp_path / "raw", "nureasoning", tmp_path / "out")
    assert path.name == f"nureasoning-mini_train/{clip.name}"
    log = Log(path)
    # The pose is that of the rear axle, 0.35 m above the ground
    np.testing.assert_allclose(log.T_world_ego[:, :3, 3], [[100 + k, 50 + 0.5 * k, 2.0] for k in range(3)])
    yaw = np.arctan2(log.T_world_ego[:, 1, 0], log.T_world_ego[:, 0, 0])
    np.testing.assert_allclose(yaw, [0.5, 0.6, 0.7])
    boxes = read_boxes(log, 1)
    assert boxes is not None
    world = log.T_world_ego[1] @ [*boxes.centre[0].tolist(), 1.0]
    np.testing.assert_allclose(world[:3], [120, 50, 3.0], atol=1e-4)
    assert float(boxes.yaw[0]) == pytest.approx(1.5 - 0.6, abs=1e-5)
    assert boxes.category.tolist() == [Category.TRUCK]
    assert boxes.velocity[0].tolist() == pytest.approx([4 * np.sin(0.6), 4 * np.cos(0.6)], abs=1e-4)
    read = read_sweep(log, 1)
    assert read is not None
    # A point at the lidar itself is no return; the other lies on the ground
    assert read[0].points_ego.tolist() == [pytest.approx([10.0, 2.0, 0.0], abs=1e-5)]
    assert read[0].beam.tolist() == [3]
    (camera,) = pinhole_cameras(log).values()
    assert camera.camera_id == CameraID.PCAM_F0
    shown = read_camera(log, 1, camera, (48, 64), with_image=True)
    np.testing.assert_allclose(shown.T_ego_cam[:3, 3], [1.5, 0.1, 1.55], atol=1e-5)
    np.testing.assert_allclose(shown.K[:, 2], [32, 24, 1])
    patch = read_map_patch(log, 1)
    (centre,) = patch.vertices[patch.kind == MapKind.LANE_CENTRE]
    (seen,) = patch.valid[patch.kind == MapKind.LANE_CENTRE]
    # A flat map lies at the height of the vehicle's ground
    line = centre[seen].double().numpy() @ log.T_world_ego[1, :3, :3].T + log.T_world_ego[1, :3, 3]
    np.testing.assert_allclose(line[:, 1:], [[50, 2.0]] * len(line), atol=1e-4)


def test_nothing_of_nureasoning_is_unpickled(tmp_path: Path) -> None:
    clip = write_nureasoning(tmp_path / "raw")
    (clip / "map.pkl").write_bytes(pickle.dumps(Intruder(f"touch {tmp_path / 'touched'}")))
    with pytest.raises(InputError, match="which plain data do not need"):
        convert(tmp_path / "raw", "nureasoning", tmp_path / "out")
    assert not (tmp_path / "touched").exists()


def test_nothing_is_unpickled_in_workers_either(tmp_path: Path) -> None:
    """Workers are new processes, in which py123d's modules are as py123d has them."""
    clip = write_nureasoning(tmp_path / "raw")
    shutil.copytree(clip, clip.with_name("whole"))
    (clip / "map.pkl").write_bytes(pickle.dumps(Intruder(f"touch {tmp_path / 'touched'}")))
    done = {
        one.name: one.failure for one in convert_all(tmp_path / "raw", "nureasoning", tmp_path / "out", 2)
    }
    assert done.pop("nureasoning-mini_train/whole") is None
    (failure,) = done.values()
    assert "which plain data do not need" in str(failure)
    assert not (tmp_path / "touched").exists()


def test_workers_convert_truckdrive_whose_modules_are_mended(tmp_path: Path) -> None:
    write_truckdrive(tmp_path / "raw")
    shutil.copytree(tmp_path / "raw" / "scene_900_1", tmp_path / "raw" / "scene_900_2")
    done = list(convert_all(tmp_path / "raw", "truckdrive", tmp_path / "out", 2))
    assert [one.failure for one in done] == [None, None]


TREES = {
    "nuscenes": "v1.0-mini/scene.json",
    "nuscenes-sweeps": "v1.0-trainval/scene.json",
    "nuplan": "nuplan-v1.1/splits/mini/x.db",
    "waymo": "training/segment-1.tfrecord",
    "waymo-motion": "validation/x.tfrecord-00000-of-00150",
}


@pytest.mark.parametrize("dataset", TREES)
def test_a_missing_package_is_one_line_that_says_how_to_get_it(dataset: str, tmp_path: Path) -> None:
    installed = {"nuscenes": HAS_NUSCENES, "waymo": HAS_TENSORFLOW}
    if installed.get(dataset.partition("-")[0]):
        pytest.skip("it is installed")
    file = tmp_path / TREES[dataset]
    file.parent.mkdir(parents=True)
    file.write_text("[]")
    with pytest.raises(InputError, match=r"needs the package \w+: pip install") as told:
        convert(tmp_path, dataset, tmp_path / "out")
    assert "\n" not in str(told.value)


def test_the_help_names_every_data_set() -> None:
    named = re.split(r"[\s,:()]+", convert_verb.__doc__ or "")
    assert set(DATASETS) <= set(named)


@pytest.mark.parametrize("dataset", DATASETS)
def test_an_empty_folder_is_told_what_was_looked_for(dataset: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"no {dataset} log here \(looked for "):
        convert(tmp_path, dataset, tmp_path / "out")
