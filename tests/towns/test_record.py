"""A recording is a 123D log that others can open, the same for the same seed, whole or not there."""

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest
import shapely
import torch
from py123d.api.scene.arrow.arrow_scene_api import ArrowSceneAPI
from py123d.datatypes import MapLayer, ModalityType, RouteMetadata
from py123d.geometry import Point2D

from foredrive.data import ClipConfig, ClipDataset, find_logs
from foredrive.data.boxes import read_boxes
from foredrive.data.log_writer import Frame, LogWriter
from foredrive.data.logs import Log, LogPath
from foredrive.errors import InputError
from foredrive.scene import Category, VoxelSpec
from foredrive.towns import recorder
from foredrive.towns.recorder import Crowd, record, split_of
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.sensing.rig import camera_rig, roof_lidar
from foredrive.towns.world import World

FRAMES = 5
RATE_HZ = 2.0


def record_small(out: Path, seed: int = 3, town: str = "Town02") -> LogPath:
    sensors = SensorSuite(camera_rig((36, 64)), roof_lidar(channels=16, azimuth_steps=180))
    return record(town, FRAMES / RATE_HZ, seed, out, RATE_HZ, sensors, Crowd(vehicles=12, people=8))


def digests(folder: Path) -> dict[str, str]:
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


@pytest.fixture
def built_already(world02: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare building the town again, for which most of the time of a small recording goes."""
    monkeypatch.setattr(recorder, "World", lambda town, seed, conditions: world02)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return record_small(tmp_path_factory.mktemp("towns"))


def test_the_same_seed_gives_the_same_bytes(recording: LogPath, tmp_path: Path) -> None:
    root = recording.maps_dir.parent
    record_small(tmp_path)
    assert digests(tmp_path) == digests(root)


@pytest.mark.usefixtures("built_already")
def test_another_seed_gives_another_drive(recording: LogPath, tmp_path: Path) -> None:
    shutil.copytree(recording.maps_dir, tmp_path / "maps")
    before = digests(tmp_path / "maps")
    other = Log(record_small(tmp_path, seed=4))
    assert not np.allclose(other.T_world_ego, Log(recording).T_world_ego)
    assert digests(tmp_path / "maps") == before  # a town's map is written once


def test_py123d_reads_all_of_it(recording: LogPath) -> None:
    scene = ArrowSceneAPI(recording.folder, maps_root=recording.maps_dir)
    metadata = scene.get_log_metadata()
    assert (metadata.split, metadata.log_name, metadata.location) == ("town_train", "Town02_seed3", "Town02")
    assert len(scene.get_all_iteration_timestamps()) == FRAMES
    assert len(scene.get_camera_metadatas()) == 6
    route = scene.get_modality_metadata(ModalityType.ROUTE_POSITION)
    assert isinstance(route, RouteMetadata)
    assert route.source == "provided"
    ego = scene.get_ego_state_se3_at_iteration(0)
    assert ego is not None
    at = Point2D(ego.rear_axle_se3.x, ego.rear_axle_se3.y)
    town = scene.get_map_api()
    assert town is not None
    lanes = town.get_map_objects_in_radius(at, 30.0, [MapLayer.LANE])[MapLayer.LANE]
    assert any(lane.shapely_polygon.buffer(0.1).contains(shapely.Point(at.x, at.y)) for lane in lanes)


def test_the_map_covers_the_drive_and_the_route_follows_it(recording: LogPath) -> None:
    log = Log(recording)
    route = log.scene.get_modality_metadata(ModalityType.ROUTE_POSITION)
    assert isinstance(route, RouteMetadata)
    for T_world_ego in log.T_world_ego:
        assert np.linalg.norm(route.polyline_xyz - T_world_ego[:3, 3], axis=1).min() < 1.7
    assert (
        route.polyline_arc_m[-1]
        > np.linalg.norm(np.diff(log.T_world_ego[:, :3, 3], axis=0), axis=1).sum() + 60
    )


def test_boxes_are_around_and_on_the_road(recording: LogPath) -> None:
    log = Log(recording)
    boxes = read_boxes(log, 0)
    assert boxes is not None
    assert len(boxes.yaw) > 5
    assert torch.linalg.vector_norm(boxes.centre, dim=-1).max() < recorder.BOXES_WITHIN_M
    bottom = boxes.centre[:, 2] - 0.5 * boxes.size_lwh[:, 2]
    assert -0.02 < bottom.min() <= bottom.max() < 0.3  # a flat town; walkways and car parks are raised
    moving = torch.linalg.vector_norm(boxes.velocity, dim=-1) > 0.5
    vehicle = boxes.category != Category.PEDESTRIAN
    heading = torch.atan2(boxes.velocity[:, 1], boxes.velocity[:, 0])
    assert (heading - boxes.yaw)[moving & vehicle].cos().min() > 0.99


def test_lidar_points_tell_hidden_boxes_from_visible_ones(recording: LogPath) -> None:
    scene = ArrowSceneAPI(recording.folder, maps_root=recording.maps_dir)
    counts = {0: 0, 1: 0}
    for frame in range(FRAMES):
        detections, lidar = scene.get_box_detections_se3_at_iteration(frame), None
        assert detections is not None
        lidar = scene.get_lidar_at_iteration(frame, next(iter(scene.get_lidar_metadatas())))
        ego = scene.get_ego_state_se3_at_iteration(frame)
        assert lidar is not None
        assert ego is not None
        world = lidar.point_cloud_3d @ ego.rear_axle_se3.rotation_matrix.T + ego.rear_axle_se3.point_3d.array
        for detection in detections:
            box = detection.bounding_box_se3
            local = (world - box.center_se3.point_3d.array) @ box.center_se3.rotation_matrix
            size = np.array([box.length, box.width, box.height])
            inside = int((np.abs(local) < 0.5 * size + 0.15).all(axis=1).sum())
            claimed = detection.attributes.num_lidar_points
            assert claimed is not None
            assert abs(inside - claimed) <= 3 + 0.3 * claimed
            counts[min(claimed, 1)] += 1
    assert min(counts.values()) > 0


def test_it_trains_as_any_log_does(recording: LogPath, tmp_path: Path) -> None:
    config = ClipConfig(
        past_frames=1,
        future_frames=1,
        image_hw=(36, 64),
        voxels=VoxelSpec(lower_m=(-16.0, -16.0, -1.0), voxel_m=1.0, shape_zyx=(4, 32, 32)),
        horizon_steps=2,
        lidar=True,
    )
    dataset = ClipDataset(find_logs(recording.folder), config, tmp_path)
    example = dataset[0]
    assert dataset.command_source["route"] == len(dataset)
    assert bool(example.clip.image_valid.all())
    assert bool(example.clip.misses_known.all())
    assert bool(example.occupancy.known.any())


def test_splits() -> None:
    assert split_of("Town05") == "town_test"
    assert split_of("Town01") == "town_train"


@pytest.mark.parametrize(
    ("town", "seconds", "rate_hz", "seed", "says"),
    [
        ("Town99", 1.0, 2.0, 0, "Town01"),
        ("Town02", 0.0, 2.0, 0, "more than 0 s"),
        ("Town02", float("nan"), 2.0, 0, "more than 0 s"),
        ("Town02", 1.0, 0.0, 0, "frame rate"),
        ("Town02", 1.0, 2.0, -1, "seed"),
    ],
)
def test_bad_arguments_are_one_clear_line(
    town: str, seconds: float, rate_hz: float, seed: int, says: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=says):
        record(town, seconds, seed, tmp_path, rate_hz)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("built_already")
@pytest.mark.parametrize("stop", [KeyboardInterrupt(), OSError(28, "No space left on device")], ids=repr)
def test_an_interrupted_recording_leaves_nothing(
    stop: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, written = LogWriter.write, []

    def write_two(self: LogWriter, frame: Frame) -> None:
        if len(written) == 2:
            raise stop
        written.append(frame)
        write(self, frame)

    monkeypatch.setattr(LogWriter, "write", write_two)
    with pytest.raises(type(stop)):
        record_small(tmp_path)
    assert len(written) == 2
    assert not [file for file in (tmp_path / "logs").rglob("*") if file.is_file()]
