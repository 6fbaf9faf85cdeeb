"""Logs written here are ordinary 123D logs: py123d's own API reads back what went in."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
from py123d.api import SceneFilter, get_filtered_scenes
from py123d.api.scene.arrow.arrow_scene_api import ArrowSceneAPI
from py123d.datatypes import LidarID

from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.log_paths import find_logs
from foredrive.data.log_writer import Frame, FullOccupancy, LogWriter
from foredrive.data.logs import Log
from foredrive.data.modalities import occupancy_metadata, pack_occupancy, unpack_beams, unpack_occupancy
from foredrive.data.recorded import read_expert_plan
from foredrive.errors import InputError
from foredrive.scene import Trajectory, VoxelSpec


def files(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


def test_py123d_finds_and_reads_the_log(tmp_path: Path) -> None:
    specs = world.cameras()
    world.write(tmp_path, frames=5, specs=specs)
    (scene,) = get_filtered_scenes(SceneFilter(), data_root=tmp_path)
    ego = scene.get_ego_state_se3_at_iteration(3)
    np.testing.assert_allclose(ego.rear_axle_se3.transformation_matrix, world.ego_pose(0.3), atol=1e-12)
    np.testing.assert_allclose(ego.dynamic_state_se3.velocity_3d.array, [world.EGO_SPEED_MPS, 0, 0])
    detections = scene.get_box_detections_se3_at_iteration(3)
    moving = next(d for d in detections if d.attributes.track_token == "11")
    expected = world.MOVING["centre"] + [world.MOVING["speed"] * 0.3, 0, 0] + world.WORLD_OFFSET
    np.testing.assert_allclose(moving.center_se3.point_3d.array, expected, atol=1e-5)
    np.testing.assert_allclose(moving.velocity_3d.array, [world.MOVING["speed"], 0, 0], atol=1e-6)
    camera = scene.get_camera_at_iteration(3, "pcam_f0")
    assert camera.metadata.camera_name == "ahead"
    error = np.abs(camera.image.astype(float) - world.image(specs[0], 0.3)).mean()
    assert error < 6  # JPEG
    np.testing.assert_allclose(
        camera.camera_to_global_se3.transformation_matrix,
        world.ego_pose(0.3) @ specs[0].T_ego_cam,
        atol=1e-9,
    )


def test_a_rolling_shutter_is_noted(tmp_path: Path) -> None:
    """123D itself reads the cameras as ever."""
    specs = [
        dataclasses.replace(spec, readout_s=s) for spec, s in zip(world.cameras(), (0.03, 0.0), strict=True)
    ]
    world.write(tmp_path, frames=2, specs=specs)
    log = Log(find_logs(tmp_path)[0])
    cameras = pinhole_cameras(log)
    frames = {name: read_camera(log, 1, camera, (48, 96), False) for name, camera in cameras.items()}
    assert {name: frame.readout_s for name, frame in frames.items()} == {"ahead": 0.03, "left": 0.0}
    np.testing.assert_allclose(frames["ahead"].T_ego_cam, specs[0].T_ego_cam, atol=1e-6)


def test_distortion_comes_back(tmp_path: Path) -> None:
    dist = np.array([-0.3, 0.1, 1e-3, -2e-3, 0.05])
    ahead, left = world.cameras()
    folder = world.write(tmp_path, frames=1, specs=[dataclasses.replace(ahead, dist=dist), left])
    log = Log(find_logs(folder)[0])
    cameras = pinhole_cameras(log)
    read = [read_camera(log, 0, cameras[name], (48, 96), with_image=False).dist for name in ("ahead", "left")]
    assert np.allclose(read[0], dist, atol=1e-6)
    assert not read[1].any()


def test_the_sweep_comes_back_with_its_misses(tmp_path: Path) -> None:
    folder = world.write(tmp_path, frames=1)
    scene = ArrowSceneAPI(folder)
    truth = world.sweep(0.0)
    lidar = scene.get_lidar_at_iteration(0, LidarID.LIDAR_TOP)
    hits = truth[truth.returned]
    np.testing.assert_allclose(lidar.xyz, hits.points_ego.numpy(), atol=1e-5)
    np.testing.assert_array_equal(lidar.channel, hits.beam.numpy())
    np.testing.assert_allclose(lidar.intensity / 255, hits.intensity.numpy(), atol=0.5 / 255 + 1e-6)
    origins, misses = unpack_beams(scene.get_custom_modality_at_iteration(0, "lidar_beams").data)
    missed = truth[~truth.returned]
    assert len(missed.beam) > 100
    np.testing.assert_allclose(origins, hits.origin_ego.numpy(), atol=1e-4)
    torch.testing.assert_close(misses.dir_ego, missed.dir_ego, atol=4e-5, rtol=0)
    torch.testing.assert_close(misses.range_m, missed.range_m)
    torch.testing.assert_close(misses.beam, missed.beam)


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    route = np.array([[100.0, -50, 0], [120, -50, 0], [120, -30, 0]])
    first = files(world.write(tmp_path / "a", frames=3, route_xyz=route))
    second = files(world.write(tmp_path / "b", frames=3, route_xyz=route))
    assert "route_position.arrow" in first
    assert first == second


def test_a_provided_route_is_kept_and_none_is_made_up(tmp_path: Path) -> None:
    route = np.array([[100.0, -50, 0], [120, -50, 0], [120, -30, 0]])
    with_route = ArrowSceneAPI(world.write(tmp_path, frames=3, name="with", route_xyz=route))
    metadata, arc_m, xyz = with_route.get_route()
    assert metadata.source == "provided"
    assert arc_m[-1] == pytest.approx(40)
    np.testing.assert_allclose(xyz[-1], route[-1], atol=1e-9)
    assert ArrowSceneAPI(world.write(tmp_path, frames=3, name="without")).get_route() is None


def test_the_experts_plan_comes_back(tmp_path: Path) -> None:
    xy = torch.tensor([[[1.0, 0.25], [2.5, 0.5]]])
    plan = Trajectory(
        xy, torch.tensor([[0.25, 0.5]]), torch.ones(1, 2, dtype=torch.bool), torch.zeros(1), 0.5
    )
    with LogWriter(tmp_path, "flat_train", "log", [], None, None, None) as writer:
        writer.write(dataclasses.replace(world.frame(0, []), expert_plan=plan))
    read = read_expert_plan(Log(find_logs(tmp_path)[0]), 0)
    assert read is not None
    assert torch.equal(read.xy, plan.xy)
    assert torch.equal(read.yaw, plan.yaw)


def test_full_occupancy_survives_packing() -> None:
    rng = np.random.default_rng(0)
    spec = VoxelSpec((-10.0, -10.0, -1.0), 0.5, (8, 40, 40))
    flat = rng.choice(8 * 40 * 40, size=300, replace=False)
    index = np.stack(np.unravel_index(flat, spec.shape_zyx), -1)
    velocity = rng.normal(0, 5, (300, 3)).astype(np.float32)
    truth = FullOccupancy(spec, index, rng.integers(-1, 12, 300), velocity)
    back = unpack_occupancy(pack_occupancy(truth), occupancy_metadata(spec))
    order = np.argsort(flat)
    assert back.spec == spec
    np.testing.assert_array_equal(back.index_zyx, index[order])
    np.testing.assert_array_equal(back.category, truth.category[order])
    np.testing.assert_allclose(back.velocity_mps, velocity[order], rtol=1e-3, atol=1e-3)


def write_and_fail(root: Path, error: BaseException) -> None:
    with LogWriter(root, "flat_train", "log", [], None, None, None) as writer:
        writer.write(world.frame(0, []))
        raise error


def write_two(root: Path, first: Frame, second: Frame) -> None:
    with LogWriter(root, "flat_train", "log", world.cameras(), None, None, None) as writer:
        writer.write(first)
        writer.write(second)


def test_nothing_is_left_when_writing_is_interrupted(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_and_fail(tmp_path, KeyboardInterrupt())
    assert list((tmp_path / "logs" / "flat_train").iterdir()) == []


def test_the_old_log_stays_when_its_successor_fails(tmp_path: Path) -> None:
    folder = world.write(tmp_path, frames=2, name="log")
    before = files(folder)
    with pytest.raises(OSError, match="No space"):
        write_and_fail(tmp_path, OSError("No space left on device"))
    assert files(folder) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"T_world_ego": np.full((4, 4), np.nan)}, "not finite"),
        ({"t_us": world.START_US - 1}, "backwards"),
        ({"images": {"nowhere": np.zeros((4, 4, 3), np.uint8)}}, "nowhere"),
        ({"images": {"ahead": np.zeros((4, 4, 3), np.uint8)}}, "ahead is"),
    ],
)
def test_a_bad_frame_is_refused(tmp_path: Path, change: dict, message: str) -> None:
    specs = world.cameras()
    bad = dataclasses.replace(world.frame(1, specs), **change)
    with pytest.raises(InputError, match=message):
        write_two(tmp_path, world.frame(0, specs), bad)


def test_a_split_that_py123d_would_not_find_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="_train"):
        LogWriter(tmp_path, "towns", "log", [], None, None, None)


def test_a_missing_map_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Town99"):
        LogWriter(tmp_path, "x_train", "log", [], tmp_path / "maps", "Town99", None)
