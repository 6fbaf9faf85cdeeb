"""Real logs, converted: PandaSet, Argoverse 2 without images, a single nuScenes key frame."""

from pathlib import Path

import numpy as np
import pytest
import torch
from nuscenes_keyframe import written_keyframe

from foredrive.data import ClipConfig, ClipDataset, LogPath
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import find_camera, pinhole_cameras, read_camera
from foredrive.data.drives import read_drive
from foredrive.data.formats.convert import convert
from foredrive.data.labels import make_labels
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.maps import read_map_patch
from foredrive.errors import InputError
from foredrive.geometry.boxes import box_corners, points_in_boxes
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import Category, MapKind, VoxelSpec

pytestmark = pytest.mark.real

SPEC = VoxelSpec((-40.0, -40.0, -1.0), 0.5, (8, 160, 160))
MOVING_FRAME = 50


@pytest.fixture(scope="session")
def converted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("converted")


@pytest.fixture(scope="session")
def pandaset(real_data: Path, converted: Path) -> LogPath:
    return convert(real_data / "pandaset", "pandaset", converted)[0]


@pytest.fixture(scope="session")
def av2(real_data: Path, converted: Path) -> dict[str, LogPath]:
    return {log.folder.name[:4]: log for log in convert(real_data / "av2", "av2", converted)}


@pytest.fixture(scope="session")
def keyframe(real_data: Path, converted: Path, tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return convert(written_keyframe(real_data, tmp_path_factory.mktemp("raw")), "nuscenes", converted)[0]


def road_height_m(log: Log, frame: int) -> float:
    """Height of the road around the ego vehicle in its frame: the lowest returns beside it, robustly."""
    points = read_sweep(log, frame)[0].points_ego
    beside = points[(points[:, 0].abs() < 6) & (points[:, 1].abs() < 4) & (points[:, 2] < 0.5)]
    return float(beside[:, 2].quantile(0.1))


def test_pandaset_holds_what_its_readme_says(pandaset: LogPath) -> None:
    log = Log(pandaset)
    assert len(log) == 56
    assert log.period_s == pytest.approx(0.1, abs=1e-3)
    assert len(pinhole_cameras(log)) == 6
    driven = np.linalg.norm(log.T_world_ego[-1, :3, 3] - log.T_world_ego[0, :3, 3])
    assert driven == pytest.approx(10, abs=1.5)
    assert np.nanmax(log.speed_mps[:20]) < 0.3
    assert abs(road_height_m(log, 0)) < 0.15
    assert 90_000 < len(read_sweep(log, 0)[0].beam) < 120_000


def test_pandaset_sweeps_are_compensated(pandaset: LogPath) -> None:
    """The lidar's own way during a sweep at 4.4 m/s shows in the beams' origins."""
    log = Log(pandaset)
    sweep, misses_known = read_sweep(log, MOVING_FRAME)
    assert not misses_known
    span = sweep.origin_ego.amax(0) - sweep.origin_ego.amin(0)
    duration_s = float(sweep.dt_s.max() - sweep.dt_s.min())
    assert span[0] == pytest.approx(log.speed_mps[MOVING_FRAME] * duration_s, rel=0.1)
    assert 0.3 < span[0] < 0.6


def test_pandaset_is_read_as_a_whole(pandaset: LogPath) -> None:
    """Every frame; the Pandar64 fires 1800 times a channel, and about one beam in ten is lost."""
    drive = read_drive(pandaset, (27, 48), ("front_camera",))
    assert len(drive.t_s) == 56
    assert bool(drive.misses_known.all())
    assert drive.rig.exposed_dt_s is not None
    assert float(drive.rig.exposed_dt_s.mean()) == pytest.approx(-0.01, abs=1e-3)
    beams = drive.sweeps[MOVING_FRAME]
    per_channel = torch.bincount(beams.beam[beams.valid], minlength=64)
    assert float((per_channel - 1800).abs().float().median()) < 60
    assert 0.85 < float(beams.returned.sum() / beams.valid.sum()) < 0.95


def test_pandaset_points_lie_in_their_cuboids_and_their_pixels(pandaset: LogPath) -> None:
    """Points inside a car's cuboid project inside the projected cuboid; most cars hold points."""
    log = Log(pandaset)
    boxes = read_boxes(log, MOVING_FRAME)
    points = read_sweep(log, MOVING_FRAME)[0].points_ego
    near = (boxes.category == Category.CAR) & (boxes.centre.norm(dim=-1) < 25)
    boxes = boxes[near]
    inside = points_in_boxes(points, boxes.centre, boxes.size_lwh, boxes.yaw)
    assert (inside.sum(0) > 30).float().mean() > 0.7
    seen_cars, size_hw = 0, (540, 960)
    for metadata in pinhole_cameras(log).values():
        camera = read_camera(log, MOVING_FRAME, metadata, size_hw, with_image=False)
        T_cam_ego = inverse_se3(camera.T_ego_cam)
        corners = box_corners(boxes.centre, boxes.size_lwh, boxes.yaw)
        for box in range(len(boxes.yaw)):
            uv, depth, _ = project(
                transform_points(T_cam_ego, corners[box]), camera.K, camera.dist, (540, 960)
            )
            if (depth < 1).any():
                continue
            mine = transform_points(T_cam_ego, points[inside[:, box]])
            pixel, _, seen = project(mine, camera.K, camera.dist, size_hw)
            if seen.sum() > 30:
                seen_cars += 1
                assert (pixel[seen] >= uv.amin(0) - 1).all()
                assert (pixel[seen] <= uv.amax(0) + 1).all()
    assert seen_cars >= 5


def test_pandaset_lidar_and_images_agree_best_where_the_calibration_puts_them(pandaset: LogPath) -> None:
    """Lidar intensity against image brightness: mutual information peaks at no offset, also while moving."""
    log = Log(pandaset)
    points = read_sweep(log, MOVING_FRAME)[0]
    points = points[points.points_ego.norm(dim=-1) < 15]
    for name in ("front_right_camera", "right_camera"):
        metadata = find_camera(pinhole_cameras(log), name)
        camera = read_camera(log, MOVING_FRAME, metadata, (540, 960), with_image=True)
        grey = camera.image.float().mean(0)

        def information(shift_px: int) -> float:
            in_camera = transform_points(inverse_se3(camera.T_ego_cam), points.points_ego)  # noqa: B023
            uv, _, seen = project(in_camera, camera.K, camera.dist, (540, 960))  # noqa: B023
            uv = uv[seen].long()
            u = (uv[:, 0] + shift_px).clamp(0, 959)
            brightness = grey[uv[:, 1], u] / 256  # noqa: B023
            joint, _, _ = np.histogram2d(points.intensity[seen].log1p(), brightness, bins=16)
            joint /= joint.sum()
            alone = joint.sum(1, keepdims=True) * joint.sum(0, keepdims=True)
            return float((joint * np.log(np.maximum(joint, 1e-12) / np.maximum(alone, 1e-12))).sum())

        shifts = [-60, -40, -20, -10, 0, 10, 20, 40, 60]
        best = shifts[int(np.argmax([information(shift) for shift in shifts]))]
        assert abs(best) <= 10


def test_pandaset_clips_load_with_flow_and_speed(pandaset: LogPath, tmp_path: Path) -> None:
    config = ClipConfig(past_frames=2, future_frames=2, image_hw=(96, 160), voxels=SPEC)
    clips = ClipDataset([pandaset], config, tmp_path)
    assert len(clips) == 8
    assert clips.command_source == {"route": 0, "driven_future": 8, "none": 0}
    example = clips[7]
    assert example.clip.image_valid.all()
    assert example.clip.ego_speed_valid.all()
    assert (example.clip.rig.readout_s > 0).all()
    known = example.occupancy.known.float().mean()
    occupied = example.occupancy.values.mean()
    assert 0.1 < known < 0.7
    assert 0.005 < occupied < 0.1
    speed = example.flow.values.norm(dim=1)[example.flow.known]
    assert 5 < speed.max() < 25
    assert (speed < 0.5).float().mean() > 0.9
    assert not clips[0].clip.ego_speed_mps.isnan().any()


def test_pandaset_standing_boxes_do_not_move(pandaset: LogPath) -> None:
    boxes = read_boxes(Log(pandaset), MOVING_FRAME)
    speed = boxes.velocity.norm(dim=-1)
    assert speed.isfinite().float().mean() > 0.95
    assert (speed < 0.2).float().mean() > 0.5
    assert 5 < speed[speed.isfinite()].max() < 25


@pytest.mark.parametrize("name", ["pandaset", "av2"])
def test_moving_vehicles_drive_forwards(pandaset: LogPath, av2: dict[str, LogPath], name: str) -> None:
    log = Log({"pandaset": pandaset, "av2": av2["7fab"]}[name])
    cosines = []
    for frame in range(0, len(log), 10):
        boxes = read_boxes(log, frame)
        boxes = boxes[(boxes.velocity.norm(dim=-1) > 2) & (boxes.category <= Category.MOTORCYCLE)]
        heading = torch.stack([boxes.yaw.cos(), boxes.yaw.sin()], dim=-1)
        cosines.append((boxes.velocity * heading).sum(-1) / boxes.velocity.norm(dim=-1))
    assert len(torch.cat(cosines)) >= 5
    assert torch.cat(cosines).quantile(0.1) > 0.9


def test_av2_loads_with_its_cameras_masked(av2: dict[str, LogPath]) -> None:
    for path in av2.values():
        config = ClipConfig(past_frames=2, future_frames=6, image_hw=(96, 160), voxels=SPEC, map=True)
        clips = ClipDataset([path], config, None)
        clip = clips[0].clip
        assert len(clips) > 20
        assert clip.images.shape[1] == 0
        assert clip.boxes_valid.all()
        assert clip.boxes.velocity[clip.boxes.valid].norm(dim=-1).nanmean() > 0.3
        kinds = set(clip.map.kind.tolist())
        assert {MapKind.LANE_CENTRE, MapKind.LANE_BOUNDARY, MapKind.CROSSWALK} <= kinds


def test_av2_lidar_lies_on_the_map_and_in_the_boxes(av2: dict[str, LogPath]) -> None:
    log = Log(av2["7fab"])
    swept = [frame for frame in range(len(log)) if read_sweep(log, frame) is not None]
    assert len(swept) == 2
    frame = swept[0]
    assert abs(road_height_m(log, frame)) < 0.25
    boxes, sweep = read_boxes(log, frame), read_sweep(log, frame)[0]
    inside = points_in_boxes(sweep.points_ego, boxes.centre, boxes.size_lwh, boxes.yaw)
    assert (inside.sum(0) > 0).float().mean() > 0.8
    patch = read_map_patch(log, frame)
    lane = patch.vertices[patch.kind == MapKind.LANE_CENTRE][patch.valid[patch.kind == MapKind.LANE_CENTRE]]
    close = lane[lane[:, :2].norm(dim=-1) < 10]
    assert close[:, 2].abs().median() < 0.3
    labels = make_labels(log, frame, SPEC)
    assert labels.occupied.sum() > 2000
    assert make_labels(log, frame - 1, SPEC).known.sum() == 0


def test_the_nuscenes_key_frame_loads(keyframe: LogPath) -> None:
    config = ClipConfig(past_frames=0, future_frames=0, image_hw=(225, 400), voxels=SPEC, lidar=True)
    clips = ClipDataset([keyframe], config, None)
    clip = clips[0].clip
    assert clips.command_source == {"route": 0, "driven_future": 0, "none": 1}
    assert clip.rig.names[0] == "CAM_FRONT"
    assert clip.image_valid.all()
    assert not clip.ego_speed_valid.any()
    assert not clip.future.valid.any()
    assert clip.sweeps.valid.sum() == 34_688 - 8  # eight lie in the sensor's own origin
    assert clip.boxes.valid.sum() == 69
    assert {Category.BARRIER, Category.PEDESTRIAN, Category.TRUCK} <= set(clip.boxes.category[0].tolist())


def test_the_nuscenes_boxes_hold_as_many_points_as_annotated(keyframe: LogPath) -> None:
    log = Log(keyframe)
    boxes, points = read_boxes(log, 0), read_sweep(log, 0)[0].points_ego
    held = points_in_boxes(points, boxes.centre, boxes.size_lwh, boxes.yaw).sum(0)
    detections = log.scene.get_box_detections_se3_at_iteration(0)
    annotated = torch.tensor([d.attributes.num_lidar_points for d in detections])
    assert (held - annotated).abs().float().mean() < 1.5
    assert abs(road_height_m(log, 0)) < 0.1


def test_a_source_without_logs_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no pandaset log here"):
        convert(tmp_path, "pandaset", tmp_path / "out")
    with pytest.raises(InputError, match="unknown data set 'lyft'"):
        convert(tmp_path, "lyft", tmp_path / "out")


def test_a_damaged_source_leaves_nothing_behind(real_data: Path, tmp_path: Path) -> None:
    source = tmp_path / "raw" / "log"
    source.mkdir(parents=True)
    for name in ("annotations_with_ego.feather", "city_SE3_egovehicle.feather"):
        data = next((real_data / "av2").glob(f"*/{name}")).read_bytes()
        (source / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="log: cannot read the raw log"):
        convert(tmp_path / "raw", "av2", tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.arrow"))
