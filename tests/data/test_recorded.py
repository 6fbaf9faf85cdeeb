"""What recordings add to a log's frames comes back from it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
from py123d.api.scene.arrow.arrow_scene_api import ArrowSceneAPI
from py123d.datatypes import (
    DefaultCameraSegmentationLabel,
    DefaultLidarSegmentationLabel,
    LidarID,
    TrafficLightStatus,
)

from foredrive.data.log_paths import LogPath
from foredrive.data.log_writer import FullOccupancy, LogWriter
from foredrive.data.logs import Log
from foredrive.data.recorded import (
    read_caption,
    read_occupancy,
    read_setting,
    read_traffic_lights,
    read_visibility,
)
from foredrive.data.setting import (
    Doing,
    LightColour,
    ObjectKind,
    Place,
    Setting,
    TimeOfDay,
    Weather,
    pack_setting,
    unpack_setting,
)
from foredrive.errors import InputError
from foredrive.scene import VoxelSpec

RNG = np.random.default_rng(0)
HW = (48, 96)
DEPTH_M = np.where(RNG.random(HW) < 0.2, np.inf, RNG.uniform(0.5, 600.0, HW)).astype(np.float32)
SEMANTIC = RNG.integers(0, 15, HW).astype(np.uint8)
LIGHTS = {40: TrafficLightStatus.RED, 7: TrafficLightStatus.GREEN}
INSTANCE = RNG.integers(0, 2**16, HW).astype(np.uint16)


SETTING = Setting(
    TimeOfDay.DUSK, Weather.FOG, Place.JUNCTION, Doing.FOLLOWS, 8.25, ObjectKind.VAN, LightColour.RED,
    hour=17.7, clouds=0.3, rain_mmph=0.0, wetness=0.2, visibility_m=150.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    root = tmp_path_factory.mktemp("recorded")
    specs = world.cameras(*HW)
    plain = world.frame(0, specs)
    beams = np.arange(len(plain.sweep.valid))
    spec = VoxelSpec((-10.0, -10.0, -1.0), 0.5, (8, 40, 40))
    full = dataclasses.replace(
        plain,
        occupancy=FullOccupancy(spec, np.array([[1, 2, 3]]), np.array([-1]), np.zeros((1, 3), np.float32)),
        visibility=np.array([0.4, 1.0], np.float32),
        setting=SETTING,
        caption="Noon, clear, on a street.",
        traffic_lights=LIGHTS,
        depth_m={"ahead": DEPTH_M},
        semantic={"ahead": SEMANTIC},
        instance={"ahead": INSTANCE},
        beam_semantic=(beams % 13).astype(np.uint8),
        beam_instance=(beams % 500).astype(np.uint16),
    )
    with LogWriter(root, "flat_train", "log", specs, None, None, None) as writer:
        writer.write(full)
        writer.write(world.frame(1, specs))
    return Log(LogPath(root / "logs" / "flat_train" / "log", root / "maps"))


def test_rows_of_a_frame_come_back_and_other_frames_have_none(log: Log) -> None:
    visibility, occupancy = read_visibility(log, 0), read_occupancy(log, 0)
    assert visibility is not None
    np.testing.assert_allclose(visibility, [0.4, 1.0], atol=5e-4)
    assert read_caption(log, 0) == "Noon, clear, on a street."
    assert read_setting(log, 0) == SETTING
    assert occupancy is not None
    np.testing.assert_array_equal(occupancy.index_zyx, [[1, 2, 3]])
    assert read_traffic_lights(log, 0) == LIGHTS
    assert read_traffic_lights(log, 1) is None
    for read in (read_visibility, read_caption, read_occupancy, read_setting):
        assert read(log, 1) is None


@pytest.mark.parametrize(
    ("field", "value"), [("weather", "drizzle"), ("place", None), ("leader", "ghost"), ("hour", "noon")]
)
def test_a_setting_that_is_none_is_refused(field: str, value: object) -> None:
    plain = pack_setting(SETTING)
    assert unpack_setting(plain) == SETTING
    with pytest.raises((ValueError, TypeError)):
        unpack_setting({**plain, field: value})


def test_py123d_reads_label_images(log: Log) -> None:
    scene = ArrowSceneAPI(log.path.folder)
    depth = scene.get_camera_depth_at_iteration(0, "pcam_f0")
    metres = depth.metadata.decode_depth(depth.image)
    np.testing.assert_array_equal(np.isnan(metres), np.isinf(DEPTH_M))
    near = np.isfinite(DEPTH_M)
    np.testing.assert_allclose(metres[near], DEPTH_M[near], atol=0.00501)
    semantic = scene.get_camera_semantic_at_iteration(0, "pcam_f0")
    np.testing.assert_array_equal(semantic.image, SEMANTIC)
    assert semantic.metadata.segmentation_label_class is DefaultCameraSegmentationLabel
    instance = scene.get_camera_instance_at_iteration(0, "pcam_f0")
    np.testing.assert_array_equal(instance.image, INSTANCE)
    rgb = scene.get_camera_at_iteration(0, "pcam_f0")
    for label in (depth, semantic, instance):
        assert label.metadata.camera_name == "ahead"
        assert label.camera_to_global_se3 == rgb.camera_to_global_se3
    assert scene.get_camera_depth_at_iteration(1, "pcam_f0") is None


def test_py123d_reads_labels_of_lidar_returns(log: Log) -> None:
    lidar = ArrowSceneAPI(log.path.folder).get_lidar_at_iteration(0, LidarID.LIDAR_TOP)
    returned = np.flatnonzero(world.sweep(0.0).returned.numpy())
    np.testing.assert_array_equal(lidar.point_cloud_features["semantic"], returned % 13)
    np.testing.assert_array_equal(lidar.point_cloud_features["instance"], returned % 500)
    assert lidar.lidar_metadatas[LidarID.LIDAR_TOP].segmentation_label_class is DefaultLidarSegmentationLabel


def test_a_label_image_of_another_size_is_refused(tmp_path: Path) -> None:
    specs = world.cameras()
    bad = dataclasses.replace(world.frame(0, specs), semantic={"ahead": np.zeros((4, 4), np.uint8)})
    writer = LogWriter(tmp_path, "flat_train", "log", specs, None, None, None)
    with pytest.raises(InputError, match="ahead is"), writer:
        writer.write(bad)
