"""The ground truth of a recording agrees with its images, sweeps, boxes and map."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from py123d.api.scene.arrow.arrow_scene_api import ArrowSceneAPI
from py123d.datatypes import DefaultCameraSegmentationLabel as Label
from py123d.datatypes import DefaultLidarSegmentationLabel as LidarLabel
from py123d.datatypes import DepthCameraMetadata, MapLayer
from small_recording import FRAMES, RATE_HZ

from foredrive.data.boxes import read_boxes
from foredrive.data.labels import make_labels
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.data.recorded import (
    read_caption,
    read_setting,
    read_signal_lamps,
    read_traffic_lights,
    read_visibility,
)
from foredrive.data.recorded_labels import recorded_labels
from foredrive.scene import Category, VoxelSpec
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.scene.traffic_light import LightState
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.recorder import LabelOptions, record
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic.expert import ExpertDrive
from foredrive.towns.traffic.traffic import Traffic

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


def test_lamps_hang_behind_the_lines_that_they_guard(recording: LogPath) -> None:
    """Those near the vehicle are recorded: 2 to 8 m above the road, up to 60 m from the line."""
    log = Log(recording)
    api = log.scene.get_map_api()
    assert api is not None
    lamps, lights = read_signal_lamps(log, 0), read_traffic_lights(log, 0)
    assert lamps
    assert lights is not None
    assert set(lamps) <= set(lights)
    for map_id, xyz in lamps.items():
        start = api.get_map_object_in_layer(map_id, MapLayer.LANE).centerline_3d.array[0]
        assert ((xyz - start)[:, 2] > 2).all()
        assert ((xyz - start)[:, 2] < 8).all()
        assert (np.linalg.norm(xyz - start, axis=1) < 60).all()
        assert (np.linalg.norm(xyz - log.T_world_ego[0, :3, 3], axis=1) < 90.1).all()


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


@pytest.mark.usefixtures("built_already")
def test_labels_may_be_left_out(tmp_path: Path) -> None:
    bare = LabelOptions(occupancy=None, visibility=False, captions=False)
    sensors = SensorSuite(camera_rig((12, 16)), roof_lidar(channels=4, azimuth_steps=36))
    log = Log(record("Town02", 1.0, 3, tmp_path, RATE_HZ, sensors, BackgroundTraffic(4, 2), bare))
    assert read_visibility(log, 0) is read_caption(log, 0) is read_setting(log, 0) is None
    written = {file.name for file in log.path.folder.glob("custom.*")}
    names = ("lidar_beams", "box_attribute", "signal_lamps")
    assert written == {f"custom.{name}.arrow" for name in names}
    boxes = read_boxes(log, 0)
    assert boxes is not None
    assert len(boxes.yaw) > 0
    told = replace(bare, captions=True)  # which take visibility, but do not leave it there
    log = Log(
        record("Town02", 0.5, 3, tmp_path, RATE_HZ, sensors, BackgroundTraffic(4, 2), told, log_name="told")
    )
    assert read_caption(log, 0)
    assert read_visibility(log, 0) is None
