"""A recording is a 123D log that others can open, the same for the same seed, whole or not there."""

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
import torch
from py123d.api.scene.arrow.arrow_scene_api import ArrowSceneAPI
from py123d.datatypes import DefaultCameraSegmentationLabel as Label
from py123d.datatypes import DefaultLidarSegmentationLabel as LidarLabel
from py123d.datatypes import DepthCameraMetadata, MapLayer, ModalityType, RouteMetadata
from py123d.geometry import Point2D

from foredrive.data import ClipConfig, ClipDataset, find_logs
from foredrive.data.boxes import read_boxes
from foredrive.data.labels import make_labels
from foredrive.data.log_paths import LogPath
from foredrive.data.log_writer import Frame, LogWriter
from foredrive.data.logs import Log
from foredrive.data.maps import read_map_patch
from foredrive.data.recorded import read_caption, read_setting, read_traffic_lights, read_visibility
from foredrive.data.recorded_labels import recorded_labels
from foredrive.errors import InputError
from foredrive.scene import Category, MapKind, VoxelSpec
from foredrive.scene.actors import BOX_RANGE_M, boxes_in_ego_frame
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.scene.traffic_light import LightState
from foredrive.sensors.vehicle import camera_rig, roof_lidar
from foredrive.towns import recorder
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.recorder import LabelOptions, record, split_of
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic.expert import ExpertDrive
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.world import World

FRAMES = 5
RATE_HZ = 2.0


def record_small(out: Path, seed: int = 3, town: str = "Town02") -> LogPath:
    sensors = SensorSuite(camera_rig((36, 64)), roof_lidar(channels=16, azimuth_steps=180))
    labels = LabelOptions(depth=True, semantic=True, instance=True)
    return record(
        town,
        FRAMES / RATE_HZ,
        seed,
        out,
        RATE_HZ,
        sensors,
        BackgroundTraffic(vehicles=12, pedestrians=8),
        labels,
    )


def digests(folder: Path) -> dict[str, str]:
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


CAMERAS = ("pcam_f0", "pcam_l0", "pcam_r0", "pcam_l1", "pcam_r1", "pcam_b0")


def instances(scene: ArrowSceneAPI, frame: int, camera: str) -> np.ndarray:
    image = scene.get_camera_instance_at_iteration(frame, camera)
    assert image is not None
    return image.image


def unprojected(log: Log, frame: int, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """Points [H W 3] in the ego frame and depths [H W] of a depth image."""
    image = log.scene.get_camera_depth_at_iteration(frame, camera)
    assert image is not None
    metadata = image.metadata
    assert isinstance(metadata, DepthCameraMetadata)
    depth = metadata.decode_depth(image.image)
    K = metadata.camera_metadata.intrinsics.camera_matrix
    v, u = np.indices(depth.shape) + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    T = metadata.camera_to_imu_se3.transformation_matrix
    return (rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3], depth


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
    assert torch.linalg.vector_norm(boxes.centre, dim=-1).max() < BOX_RANGE_M
    bottom = boxes.centre[:, 2] - 0.5 * boxes.size_lwh[:, 2]
    assert -0.02 < bottom.min() <= bottom.max() < 0.3  # a flat town; walkways and car parks are raised
    moving = torch.linalg.vector_norm(boxes.velocity, dim=-1) > 0.5
    vehicle = boxes.category != Category.PEDESTRIAN
    heading = torch.atan2(boxes.velocity[:, 1], boxes.velocity[:, 0])
    assert (heading - boxes.yaw)[moving & vehicle].cos().min() > 0.99


def test_traffic_lights_stand_at_the_lanes_that_they_guard(recording: LogPath, town02: TownMap) -> None:
    """The map's lanes of the recorded ids are those behind the lights, which show what the traffic obeys."""
    log, traffic = Log(recording), Traffic(town02, 3, 13, 8)
    api = log.scene.get_map_api()
    assert api is not None
    ends = {lane.lane_id: lane.centreline_xyz[[0, -1], :2] for lane in town02.lanes}
    began_s = ExpertDrive(traffic, FRAMES / RATE_HZ).state.time_s
    for frame in range(FRAMES):
        recorded = read_traffic_lights(log, frame)
        assert recorded is not None
        assert len(recorded) == sum(len(zone.lane_ids) for zone in town02.stop_zones)
        assert len(set(recorded.values())) > 1
        shown = traffic.zone_lights(began_s + frame / RATE_HZ).tolist()
        of_lane = {i: zone for zone, stop in enumerate(town02.stop_zones) for i in stop.lane_ids}
        for map_id, status in recorded.items():
            line = api.get_map_object_in_layer(map_id, MapLayer.LANE).centerline.array[[0, -1], :2]
            (lane,) = (i for i in of_lane if np.abs(ends[i] - line).max() < 0.01)
            assert status.name == LightState(shown[of_lane[lane]]).name


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
        features = lidar.point_cloud_features
        assert features is not None
        world = lidar.point_cloud_3d @ ego.rear_axle_se3.rotation_matrix.T + ego.rear_axle_se3.point_3d.array
        for detection in detections:
            box = detection.bounding_box_se3
            size = np.array([box.length, box.width, box.height])
            mine = features["instance"] == int(detection.attributes.track_token)
            since_s = (ego.timestamp.time_us - features["timestamps"][mine, None]) * 1e-6
            moved_on = world[mine] + since_s * detection.velocity_3d.array
            local = (moved_on - box.center_se3.point_3d.array) @ box.center_se3.rotation_matrix
            claimed = detection.attributes.num_lidar_points
            assert claimed == mine.sum()
            inside = (np.abs(local) < 0.5 * size + 0.15).all(axis=1)
            assert inside.sum() >= 0.7 * claimed - 3
            counts[min(claimed, 1)] += 1
    assert min(counts.values()) > 0


def test_visibility_tells_seen_boxes_from_hidden_ones(recording: LogPath) -> None:
    log = Log(recording)
    scene, some = log.scene, set()
    for frame in range(FRAMES):
        boxes, visibility = read_boxes(log, frame), read_visibility(log, frame)
        assert boxes is not None
        assert visibility is not None
        assert ((visibility >= 0) & (visibility <= 1)).all()
        shown = {int(i) for camera in CAMERAS for i in np.unique(instances(scene, frame, camera))} - {0}
        tracks = boxes.track_id.tolist()
        assert {t for t, v in zip(tracks, visibility.tolist(), strict=True) if v > 0} == shown & set(tracks)
        some |= set(np.digitize(visibility, [0.01, 0.99]).tolist())
    assert some == {0, 1, 2}


def test_instances_lie_in_their_boxes_at_their_depth(recording: LogPath) -> None:
    log, found = Log(recording), 0
    boxes = read_boxes(log, 0)
    assert boxes is not None
    row_of = {int(track): row for row, track in enumerate(boxes.track_id)}
    for camera in CAMERAS:
        points, depth = unprojected(log, 0, camera)
        track = instances(log.scene, 0, camera)
        for name in set(np.unique(track).tolist()) & set(row_of):
            row = row_of[name]
            local = points[track == name] - boxes.centre[row].numpy()
            turn = -float(boxes.yaw[row])
            R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
            reach = 0.5 * boxes.size_lwh[row].numpy() + 0.01 + 1e-3 * depth[track == name][:, None]
            assert (np.abs(local @ R.T) <= reach).all()
            found += 1
    assert found > 3


def test_the_road_is_level_where_depth_says_it_is(recording: LogPath) -> None:
    log = Log(recording)  # of a flat town
    points, depth = unprojected(log, 0, "pcam_f0")
    semantic = log.scene.get_camera_semantic_at_iteration(0, "pcam_f0")
    assert semantic is not None
    road = semantic.image == int(Label.ROAD)
    assert road.sum() > 300
    assert np.abs(points[road][:, 2] - 0.0).max() < 0.06  # the carriageway's camber, and 1 cm of depth
    assert depth[road].max() > 30.0
    assert np.isnan(depth[semantic.image == int(Label.SKY)]).all()
    assert np.isfinite(depth[semantic.image != int(Label.SKY)]).all()


def test_lidar_returns_carry_the_classes_of_what_they_met(recording: LogPath) -> None:
    log = Log(recording)
    lidar = log.scene.get_lidar_at_iteration(0, next(iter(log.scene.get_lidar_metadatas())))
    boxes = read_boxes(log, 0)
    assert lidar is not None
    assert boxes is not None
    features = lidar.point_cloud_features
    assert features is not None
    ground = features["semantic"] == int(LidarLabel.DRIVABLE_SURFACE)
    assert ground.sum() > 100
    assert np.abs(lidar.xyz[ground][:, 2]).max() < 0.3  # range noise
    category = dict(zip(boxes.track_id.tolist(), boxes.category.tolist(), strict=True))
    for track in set(np.unique(features["instance"]).tolist()) & set(category):
        person = category[track] == Category.PEDESTRIAN
        met = features["semantic"][features["instance"] == track]
        assert ((met == int(LidarLabel.PERSON)) == person).all()
    assert (features["instance"][ground] == 0).all()


def test_recorded_occupancy_agrees_with_what_lidar_has_met(recording: LogPath) -> None:
    """On a grid whose voxels have the road in their middle; range noise puts points beside thin things."""
    log, spec = Log(recording), VoxelSpec((-24.0, -24.0, -1.5), 1.0, (6, 48, 48))
    met, agreed = 0, 0
    for frame in range(FRAMES):
        seen, all_there_is = make_labels(log, frame, spec), recorded_labels(log, frame, spec)
        assert all_there_is.known.all()
        met += int(seen.occupied.sum())
        agreed += int((seen.occupied & all_there_is.occupied).sum())
        around = torch.nn.functional.max_pool3d(all_there_is.occupied[None].float(), 3, 1, 1)[0] > 0
        assert not (seen.occupied & ~around).any()
        moving = seen.occupied & all_there_is.occupied & (seen.flow_mps.norm(dim=0) > 1.0)
        apart = (seen.flow_mps - all_there_is.flow_mps)[:, moving].norm(dim=0)
        assert apart.numel() == 0 or apart.median() < 0.05
    assert agreed > 0.98 * met > 1000


def test_every_frame_has_a_caption(recording: LogPath) -> None:
    log = Log(recording)
    captions = [read_caption(log, frame) for frame in range(FRAMES)]
    assert all(caption and caption.endswith(".") for caption in captions)


def test_every_frame_has_its_setting(recording: LogPath) -> None:
    log = Log(recording)
    settings = [read_setting(log, frame) for frame in range(FRAMES)]
    assert [setting.speed_mps for setting in settings] == pytest.approx(log.speed_mps, abs=0.05)
    assert len({(setting.time_of_day, setting.weather, setting.hour) for setting in settings}) == 1


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


@pytest.mark.usefixtures("built_already")
def test_labels_may_be_left_out(tmp_path: Path) -> None:
    bare = LabelOptions(occupancy=None, visibility=False, captions=False)
    sensors = SensorSuite(camera_rig((12, 16)), roof_lidar(channels=4, azimuth_steps=36))
    log = Log(record("Town02", 1.0, 3, tmp_path, RATE_HZ, sensors, BackgroundTraffic(4, 2), bare))
    assert read_visibility(log, 0) is read_caption(log, 0) is read_setting(log, 0) is None
    written = {file.name for file in log.path.folder.glob("custom.*")}
    assert written == {"custom.lidar_beams.arrow", "custom.box_attribute.arrow"}
    boxes = read_boxes(log, 0)
    assert boxes is not None
    assert len(boxes.yaw) > 0
    told = replace(bare, captions=True)  # which take visibility, but do not leave it there
    log = Log(
        record("Town02", 0.5, 3, tmp_path, RATE_HZ, sensors, BackgroundTraffic(4, 2), told, log_name="told")
    )
    assert read_caption(log, 0)
    assert read_visibility(log, 0) is None


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
