"""A recording is a 123D log that others can open, the same for the same seed, whole or not there."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import shapely
import torch
from file_digests import digests
from py123d.api.scene.arrow.arrow_scene_api import ArrowSceneAPI
from py123d.datatypes import MapLayer, ModalityType, RouteMetadata
from py123d.geometry import Point2D
from small_recording import FRAMES, record_small

from foredrive.data import ClipConfig, ClipDataset, find_logs
from foredrive.data.boxes import read_boxes
from foredrive.data.log_paths import LogPath
from foredrive.data.log_writer import Frame, LogWriter
from foredrive.data.logs import Log
from foredrive.data.maps import read_map_patch
from foredrive.errors import InputError
from foredrive.scene import Category, MapKind, VoxelSpec
from foredrive.scene.actors import BOX_RANGE_M, boxes_in_ego_frame
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.recorder import record, split_of
from foredrive.towns.traffic.expert import ExpertDrive
from foredrive.towns.traffic.traffic import Traffic


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
    assert torch.linalg.vector_norm(boxes.centre, dim=-1).max() < BOX_RANGE_M
    bottom = boxes.centre[:, 2] - 0.5 * boxes.size_lwh[:, 2]
    assert -0.02 < bottom.min() <= bottom.max() < 0.3  # a flat town; walkways and car parks are raised
    moving = torch.linalg.vector_norm(boxes.velocity, dim=-1) > 0.5
    vehicle = boxes.category != Category.PEDESTRIAN
    heading = torch.atan2(boxes.velocity[:, 1], boxes.velocity[:, 0])
    assert (heading - boxes.yaw)[moving & vehicle].cos().min() > 0.99


def test_the_map_is_around_the_vehicle(recording: LogPath) -> None:
    log = Log(recording)
    patch = read_map_patch(log, 0)
    centre = patch.vertices[patch.kind == MapKind.LANE_CENTRE]
    valid = patch.valid[patch.kind == MapKind.LANE_CENTRE]
    near = torch.linalg.vector_norm(centre, dim=-1)[valid]
    assert near.min() < 2.0
    assert {MapKind.LANE_BOUNDARY, MapKind.INTERSECTION, MapKind.ROAD_EDGE} <= set(patch.kind.tolist())


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


def test_boxes_move_as_their_velocities_say(town02: TownMap) -> None:
    """At the time of the frame; only who starts, stops or turns on the spot differs."""
    dt_s, at, velocity = 0.05, {}, {}
    traffic = Traffic(town02, 3, 13, 8)
    for k, moment in enumerate(ExpertDrive(traffic, 3.0).snapshots(60, dt_s)):
        boxes, R = boxes_in_ego_frame(moment.actors, moment.T_world_ego), moment.T_world_ego[:3, :3]
        for row, track in enumerate(boxes.track_id.tolist()):
            at[track, k] = R @ boxes.centre[row].double().numpy() + moment.T_world_ego[:3, 3]
            velocity[track, k] = R @ [*boxes.velocity[row].tolist(), 0.0]
    inner = [(track, k) for track, k in at if {(track, k - 1), (track, k + 1)} <= at.keys()]
    difference = np.array([(at[t, k + 1] - at[t, k - 1]) / (2 * dt_s) for t, k in inner])
    logged = np.array([velocity[key] for key in inner])
    apart = np.linalg.norm((difference - logged)[:, :2], axis=1)
    assert (np.linalg.norm(logged, axis=1) > 0.5).sum() > 200
    assert np.median(apart) < 0.005
    assert np.quantile(apart, 0.95) < 0.15


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
