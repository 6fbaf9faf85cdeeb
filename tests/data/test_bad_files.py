"""Every reader of files of other people, on every kind of damage to every kind of its files.

A reader may refuse a damaged file by one line that names it, leave out what is damaged by a notice that names
it, or read it if what is left is whole. It never ends in another error, never hangs, and never runs what a
file brings. Damage that is read without a notice is in `HARMLESS`.
"""

import dataclasses
import json
import pickle
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import bad_files
import made_bags
import numpy as np
import pandas as pd
import pytest
import raw_kitti360
import raw_nuscenes
import raw_pandaset
import test_kitti_object
import test_kitti_raw
import yaml
from miniature import miniature, write_log
from PIL import Image

from foredrive.data.boxes import read_tracks
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.clip_list import ListedClip, clip_list, read_clip_list, write_clip_list
from foredrive.data.formats.bag_proposal import propose_topics
from foredrive.data.formats.bag_topics import topics_file
from foredrive.data.formats.convert import convert
from foredrive.data.formats.nuscenes_names import read_table
from foredrive.data.lidar import read_sweep
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.data.notices import read_notices
from foredrive.driving.ncap.scenario_file import load_scenarios
from foredrive.driving.route_sets import read_carla_routes
from foredrive.engine.config import save_recipe
from foredrive.errors import InputError
from foredrive.methods.reconstruction.edits import Remove, load_edits, save_edits
from foredrive.runs.drive.records import read_suite
from foredrive.runs.recipes.world_models import load_recipe
from foredrive.runs.train.run import open_run
from foredrive.search.rows import SCORES
from foredrive.search.scores import read_scores
from foredrive.sensors.rigs import SURROUND, find_rig
from foredrive.tasks.occupancy.files import read_poses

TOO_LONG_S = 20


@dataclasses.dataclass(frozen=True)
class Reader:
    """One reader: writes good files into a folder, reads them; which of the files are damaged."""

    write: Callable[[Path], None]
    read: Callable[[Path], Any]
    files: tuple[str, ...]


def pandaset(root: Path) -> None:
    raw_pandaset.write(root / "raw")


def kitti_object(root: Path) -> None:
    test_kitti_object.made.__wrapped__(root)
    shutil.move(root / "kitti", root / "raw")


def kitti_raw(root: Path) -> None:
    test_kitti_raw.made.__wrapped__(root)


def kitti360(root: Path) -> None:
    raw_kitti360.write(root / "raw")


def own_nuscenes(root: Path) -> None:
    raw_nuscenes.write(root / "raw", "v1.0-own")


def nerfstudio(root: Path) -> None:
    folder = root / "raw"
    (folder / "images").mkdir(parents=True)
    Image.new("RGB", (32, 16)).save(folder / "images" / "a.png")
    frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}
    whole = {"fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 8.0, "w": 32, "h": 16, "frames": [frame]}
    (folder / "transforms.json").write_text(json.dumps(whole))


def ros1(root: Path) -> None:
    (root / "raw").mkdir()
    made_bags.write_ros1(root / "raw" / "drive.bag")
    propose_topics(root / "raw" / "drive.bag", topics_file(root / "raw" / "drive.bag"))


def ros2(root: Path) -> None:
    (root / "raw").mkdir()
    made_bags.write_ros2(root / "folder", made_bags.StoragePlugin.MCAP)
    (file,) = (root / "folder").glob("*.mcap")
    file.rename(root / "raw" / "drive.mcap")
    propose_topics(root / "raw" / "drive.mcap", topics_file(root / "raw" / "drive.mcap"))


def ros2_folder(root: Path) -> None:
    (root / "raw").mkdir()
    made_bags.write_ros2(root / "raw" / "drive", made_bags.StoragePlugin.MCAP)
    propose_topics(root / "raw" / "drive", topics_file(root / "raw" / "drive"))


def converted(dataset: str) -> Callable[[Path], Any]:
    return lambda root: convert(root / "raw", dataset, root / "out")


def write_own_log(root: Path) -> None:
    path = write_log(root / "data", frames=3)
    shutil.copytree(path.folder, root / "raw")


def read_log(root: Path) -> None:
    log = Log(LogPath(root / "raw", root / "maps"))
    for frame in range(len(log)):
        read_sweep(log, frame)
        for camera in pinhole_cameras(log).values():
            read_camera(log, frame, camera, (16, 32), with_image=True)
    read_tracks(log)


def write_partial_av2(root: Path) -> None:
    folder = root / "raw"
    folder.mkdir()
    pose = {"tx_m": 0.0, "ty_m": 0.0, "tz_m": 0.0, "qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0}
    times = [100_000_000, 200_000_000]
    pd.DataFrame([{"timestamp_ns": t} | pose for t in times]).to_feather(
        folder / "city_SE3_egovehicle.feather"
    )
    box = {"category": "REGULAR_VEHICLE", "track_uuid": "a", "num_interior_pts": 5}
    size = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5}
    boxes = [{"timestamp_ns": t} | pose | size | box for t in times]
    pd.DataFrame(boxes).to_feather(folder / "annotations.feather")
    (folder / "map").mkdir()
    empty = {"pedestrian_crossings": {}, "lane_segments": {}, "drivable_areas": {}}
    (folder / "map" / f"log_map_archive_{folder.name}____PIT_city_1.json").write_text(json.dumps(empty))


def write_routes(root: Path) -> None:
    points = "".join(f'<waypoint x="{k}" y="0" z="0"/>' for k in range(3))
    (root / "routes.xml").write_text(f'<routes><route id="1" town="Town01">{points}</route></routes>')


def write_rig(root: Path) -> None:
    (root / "rig.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(dataclasses.asdict(SURROUND)))))


def write_poses(root: Path) -> None:
    frame: dict[str, Any] = {
        "token": "a",
        "timestamp": 0.0,
        "lidar2ego_translation": [0, 0, 1.8],
        "lidar2ego_rotation": [1, 0, 0, 0],
    }
    frame |= {"ego2global_translation": [0, 0, 0], "ego2global_rotation": [1, 0, 0, 0]}
    (root / "infos.pkl").write_bytes(pickle.dumps({"infos": [frame]}))


def write_scenario(root: Path) -> None:
    actor = {"uuids": ["a"], "times": [0.0, 20.0], "positions": [[5.0, 1.0, 0.0]] * 2, "initial-yaw": 2.5}
    general = {"start-pose": "original", "start-frame": 20, "time-step": 0.5, "duration": 10.0}
    jitter = {
        "times": [0.0, 1.0],
        "longitudinal": 6.0,
        "lateral": 1.0,
        "long-lat-angle": 2.5,
        "yaw-jitter": 1.0,
    }
    theirs = {
        "general": general | {"priming-steps": 2, "smooth-actors": True, "start-jitter": 1},
        "actors": [
            actor | {"flip_uuids": ["b"], "mode": "override", "is_target_actor": True, "jitter": jitter}
        ],
    }
    file = root / "stationary" / "0101.yaml"
    file.parent.mkdir()
    file.write_text(yaml.safe_dump(theirs))


def write_table(root: Path) -> None:
    (root / "sample.json").write_text(json.dumps([{"token": "a"}]))


def write_suite(root: Path) -> None:
    (root / "suite.json").write_text(json.dumps({"agent": "stop", "routes": "town05_short"}))


def write_run(root: Path) -> None:
    save_recipe(miniature(), root / "config.yaml")
    logs = [{"folder": "a", "maps_dir": "b", "parts_s": []}]
    (root / "logs.json").write_text(json.dumps({"logs": logs, "cache_dir": "c"}))


READERS: dict[str, Reader] = {
    "pandaset": Reader(
        pandaset,
        converted("pandaset"),
        (
            "raw/annotations/cuboids/00.pkl.gz",
            "raw/lidar/00.pkl.gz",
            "raw/meta/timestamps.json",
            "raw/camera/left_camera/poses.json",
            "raw/camera/left_camera/intrinsics.json",
        ),
    ),
    "kitti-object": Reader(
        kitti_object,
        converted("kitti-object"),
        (
            "raw/training/calib/000007.txt",
            "raw/training/label_2/000007.txt",
            "raw/training/velodyne/000007.bin",
            "raw/training/image_2/000007.png",
        ),
    ),
    "kitti-raw": Reader(
        kitti_raw,
        converted("kitti-raw"),
        (
            "raw/2011_09_26/calib_cam_to_cam.txt",
            f"raw/2011_09_26/{test_kitti_raw.DRIVE}/oxts/timestamps.txt",
            f"raw/2011_09_26/{test_kitti_raw.DRIVE}/oxts/data/{1:010d}.txt",
            f"raw/2011_09_26/{test_kitti_raw.DRIVE}/velodyne_points/data/{1:010d}.bin",
            f"raw/2011_09_26/{test_kitti_raw.DRIVE}/image_02/data/{1:010d}.png",
        ),
    ),
    "kitti360": Reader(
        kitti360,
        converted("kitti360"),
        (
            f"raw/data_3d_bboxes/train/{raw_kitti360.DRIVE}.xml",
            f"raw/data_poses/{raw_kitti360.DRIVE}/poses.txt",
            "raw/calibration/image_02.yaml",
        ),
    ),
    "nuscenes": Reader(
        own_nuscenes,
        converted("nuscenes-sweeps"),
        (
            "raw/v1.0-own/scene.json",
            "raw/v1.0-own/sample_data.json",
            "raw/v1.0-own/ego_pose.json",
            "raw/v1.0-own/calibrated_sensor.json",
            "raw/v1.0-own/sample_annotation.json",
            "raw/samples/LIDAR_TOP/LIDAR_TOP-0.pcd.bin",
        ),
    ),
    "nerfstudio": Reader(nerfstudio, converted("nerfstudio"), ("raw/transforms.json", "raw/images/a.png")),
    "ros1": Reader(ros1, converted("rosbag"), ("raw/drive.bag", "raw/drive.bag.topics.yaml")),
    "ros2": Reader(ros2, converted("rosbag"), ("raw/drive.mcap",)),
    "ros2 folder": Reader(ros2_folder, converted("rosbag"), ("raw/drive/metadata.yaml",)),
    "av2": Reader(
        write_partial_av2,
        converted("av2"),
        (
            "raw/annotations.feather",
            "raw/city_SE3_egovehicle.feather",
            "raw/map/log_map_archive_raw____PIT_city_1.json",
        ),
    ),
    "log": Reader(
        write_own_log,
        read_log,
        (
            "raw/sync.arrow",
            "raw/ego_state_se3.arrow",
            "raw/lidar.lidar_top.arrow",
            "raw/camera.pcam_f0.arrow",
        ),
    ),
    "clip list": Reader(
        lambda root: write_clip_list(root / "clips.json", clip_list([ListedClip(root, root, 0.0, 1.0)])),
        lambda root: read_clip_list(root / "clips.json"),
        ("clips.json",),
    ),
    "recipe": Reader(
        lambda root: save_recipe(miniature(), root / "own.yaml"),
        lambda root: load_recipe(root / "own.yaml"),
        ("own.yaml",),
    ),
    "rig": Reader(write_rig, lambda root: find_rig(str(root / "rig.yaml")), ("rig.yaml",)),
    "edits": Reader(
        lambda root: save_edits([Remove(3)], root / "edits.json"),
        lambda root: load_edits(root / "edits.json"),
        ("edits.json",),
    ),
    "routes": Reader(write_routes, lambda root: read_carla_routes(root / "routes.xml"), ("routes.xml",)),
    "scenarios": Reader(
        write_scenario,
        lambda root: load_scenarios(root / "stationary" / "0101.yaml"),
        ("stationary/0101.yaml",),
    ),
    "tables": Reader(write_table, lambda root: read_table(root / "sample.json"), ("sample.json",)),
    "suite": Reader(write_suite, read_suite, ("suite.json",)),
    "run": Reader(write_run, open_run, ("config.yaml", "logs.json")),
    "scores": Reader(
        lambda root: (root / "scores.json").write_text(f'{{"frame": "log@100", "{SCORES[0]}": 0.5}}'),
        lambda root: read_scores(root / "scores.json"),
        ("scores.json",),
    ),
    "poses of results": Reader(write_poses, lambda root: read_poses(root / "infos.pkl"), ("infos.pkl",)),
}

WITHOUT_NUMBERS = (("tables", "sample.json"), ("suite", "suite.json"), ("run", "logs.json"))
OF_NUMBERS = ("not a number", "texts for numbers")
HARMLESS = {
    ("pandaset", "timestamps.json", "an entry missing"),  # a list of numbers has no entries with names
    ("kitti-object", "000007.txt", "null bytes"),  # before P0, which is not read
    ("kitti-object", "000007.txt", "empty"),  # labels of nothing
    ("kitti-object", "000007.txt", "cut in half"),  # the first label is left, and a DontCare
    ("kitti-object", "000007.txt", "too few"),  # the score of each label is not read
    ("kitti-object", "000007.bin", "empty"),
    ("kitti-object", "000007.bin", "cut in half"),  # one point is left
    ("kitti-object", "000007.bin", "zeros"),  # beams without range are no returns
    ("kitti-raw", "0000000001.txt", "too few"),  # only the first six numbers are read
    ("kitti-raw", "0000000001.bin", "empty"),
    ("kitti-raw", "0000000001.bin", "zeros"),
    ("nuscenes", "scene.json", "not a number"),  # the number of samples, which is not read
    ("nuscenes", "scene.json", "texts for numbers"),
    ("nuscenes", "ego_pose.json", "not a number"),  # the time, which that of the reading stands for
    ("nuscenes", "LIDAR_TOP-0.pcd.bin", "empty"),
    ("nuscenes", "LIDAR_TOP-0.pcd.bin", "cut in half"),  # one point is left
    ("nuscenes", "LIDAR_TOP-0.pcd.bin", "zeros"),
    ("kitti360", "image_02.yaml", "null bytes"),  # in the first line, which is not YAML in OpenCV's files
    ("kitti360", f"{raw_kitti360.DRIVE}.xml", "another root"),  # without any object
    ("av2", "log_map_archive_raw____PIT_city_1.json", "not a number"),  # an empty map has no numbers
    ("av2", "log_map_archive_raw____PIT_city_1.json", "texts for numbers"),
    *(
        ("scenarios", "0101.yaml", damage)  # neuro-ncap's files may say more than is read, and all as text
        for damage in ("an unknown entry", "a date that is none", "a huge integer")
    ),
    *(
        ("kitti360", "image_02.yaml", damage)  # read by py123d, which copies nothing of it
        for damage in ("an alias of itself", "an entry twice", "longer than any")
    ),
    *(
        ("ros2 folder", "metadata.yaml", damage)  # only the names of the files are read of it
        for damage in ("an unknown entry", "an alias of itself", "longer than any", "cut in half")
    ),
    ("scores", "scores.json", "empty"),  # no frame is scored
    ("scores", "scores.json", "not a number"),  # scores may be infinite or unknown
    *((name, file, damage) for name, file in WITHOUT_NUMBERS for damage in OF_NUMBERS),
}
"""Reader, file and damage that are read, because what is left is whole."""

CASES = [
    (reader, file, damage)
    for reader, made in READERS.items()
    for file in made.files
    for damage in bad_files.damages(Path(file))
]


def test_there_are_at_least_two_hundred_kinds() -> None:
    assert len(CASES) >= 200


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A folder of each reader's good files, which it reads."""
    made: dict[str, Path] = {}

    def folder(name: str) -> Path:
        if name not in made:
            made[name] = tmp_path_factory.mktemp(name.replace(" ", "-"))
            READERS[name].write(made[name])
        return made[name]

    return folder


@pytest.fixture
def watched() -> Iterator[None]:
    """Interrupt a reader that hangs, by what no reader takes for a damaged file."""

    def too_long(*_: object) -> None:
        raise KeyboardInterrupt(f"it took longer than {TOO_LONG_S} s")

    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(TOO_LONG_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("name", READERS)
def test_the_good_files_are_read(name: str, good: Callable[[str], Path], tmp_path: Path) -> None:
    shutil.copytree(good(name), tmp_path / "tree")
    READERS[name].read(tmp_path / "tree")


@pytest.mark.usefixtures("watched")
@pytest.mark.parametrize(("reader", "file", "damage"), CASES, ids=[" ".join(case) for case in CASES])
def test_a_damaged_file_is_one_line(
    reader: str, file: str, damage: str, good: Callable[[str], Path], tmp_path: Path
) -> None:
    shutil.copytree(good(reader), tmp_path / "tree")
    damaged = tmp_path / "tree" / file
    damaged.write_bytes(bad_files.damages(damaged)[damage](damaged.read_bytes()))
    try:
        READERS[reader].read(tmp_path / "tree")
    except InputError as error:
        told = str(error)
        assert "\n" not in told.strip(), told
        assert len(told) < 1000, told[:200]
        assert damaged.name in told or damaged.parent.name in told, f"{told!r} does not name {damaged.name}"
    else:
        notices = [
            line for file in (tmp_path / "tree").rglob("notices.json") for line in read_notices(file.parent)
        ]
        named = any(damaged.name in line for line in notices)
        assert named or (reader, Path(file).name, damage) in HARMLESS
