"""The truth of tasks in a small recording of a town: exact, and consistent with its other labels."""

import numpy as np
import pytest
import torch

from foredrive.data import ClipConfig, ClipDataset, LogPath
from foredrive.data.boxes import read_boxes
from foredrive.data.clip_config import TaskTruthConfig
from foredrive.data.logs import Log
from foredrive.data.recorded import read_visibility
from foredrive.data.recorded_labels import recorded_labels
from foredrive.data.truth.tasks import tasks_of
from foredrive.scene import Attribute, Category, Example
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.scene.map_elements import ElementKind, RasterLayer
from foredrive.scene.semantics import VOXEL_CLASSES
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns import recorder
from foredrive.towns.recorder import OCCUPANCY, record
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.world import World

RATE_HZ, FRAMES = 2.0, 17


@pytest.fixture(scope="module")
def log(world02: World, tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    """8 s of Town02 with small images."""
    sensors = SensorSuite(camera_rig((36, 64)), roof_lidar(channels=16, azimuth_steps=180))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorder, "World", lambda town, seed, conditions: world02)
        out = tmp_path_factory.mktemp("town")
        return record("Town02", FRAMES / RATE_HZ, 3, out, RATE_HZ, sensors, BackgroundTraffic(20, 12))


@pytest.fixture(scope="module")
def example(log: LogPath) -> Example:
    config = ClipConfig(0, 0, (36, 64), OCCUPANCY, occupancy_source="recorded", tasks=TaskTruthConfig())
    return ClipDataset([log], config, None)[2]


def test_a_recording_can_judge_all_tasks(log: LogPath) -> None:
    assert all(support.judged for support in tasks_of(Log(log)))


def test_boxes_have_exact_labels(log: LogPath) -> None:
    read = Log(log)
    for frame in range(0, FRAMES, 4):
        boxes, share = read_boxes(read, frame), read_visibility(read, frame)
        assert boxes is not None
        assert share is not None
        assert boxes.num_points.min() >= 0
        assert ((boxes.visibility - 1) == torch.from_numpy(np.digitize(share, [0.4, 0.6, 0.8]))).all()
        for category, attribute, velocity in zip(
            boxes.category, boxes.attribute, boxes.velocity, strict=True
        ):
            label = Attribute(int(attribute)).label
            assert label.startswith(
                {
                    Category.PEDESTRIAN: "pedestrian",
                    Category.BICYCLE: "cycle",
                    Category.MOTORCYCLE: "cycle",
                }.get(Category(int(category)), "vehicle")
            )
            if not label.startswith("cycle"):
                assert label.endswith("moving") == (float(velocity.norm()) > 0.2)


def test_futures_are_the_boxes_of_later_frames(log: LogPath, example: Example) -> None:
    """At 2 Hz each step is a frame: the future is that frame's box, seen from now."""
    assert example.truth is not None
    futures = example.truth.futures
    assert futures is not None
    read, checked = Log(log), 0
    T_now_world = np.linalg.inv(read.T_world_ego[2])
    row_of = {int(track): row for row, track in enumerate(example.clip.boxes.track_id[0])}
    for step in range(12):
        boxes = read_boxes(read, 3 + step)
        assert boxes is not None
        T_now_later = T_now_world @ read.T_world_ego[3 + step]
        centre = boxes.centre.double().numpy() @ T_now_later[:3, :3].T + T_now_later[:3, 3]
        there = {int(track): xyz for track, xyz in zip(boxes.track_id, centre, strict=True)}
        for track, row in row_of.items():
            assert bool(futures.valid[row, step]) == (track in there)
            if track in there:
                checked += 1
                np.testing.assert_allclose(futures.xy[row, step].numpy(), there[track][:2], atol=2e-3)
    assert checked > 50


def test_the_map_agrees_with_the_exact_voxels(example: Example) -> None:
    """The middles of lanes and the drivable area lie on voxels of the road."""
    truth = example.truth
    assert truth is not None
    assert truth.elements is not None
    assert truth.raster is not None
    assert truth.semantics is not None
    kinds = truth.elements.kind.tolist()
    assert ElementKind.BOUNDARY in kinds
    assert ElementKind.DIVIDER in kinds
    centre = truth.elements.vertices[truth.elements.kind == ElementKind.CENTRELINE]
    points = centre[truth.elements.valid[truth.elements.kind == ElementKind.CENTRELINE]]
    road = (truth.semantics.index == VOXEL_CLASSES["occ3d"].index("driveable_surface")).any(dim=0)
    x, y = ((points[:, axis] - OCCUPANCY.lower_m[axis]) / OCCUPANCY.voxel_m for axis in (0, 1))
    assert road[y.long(), x.long()].float().mean() > 0.85
    drivable = truth.raster.layers[RasterLayer.DRIVABLE]
    assert drivable[100, 100]


def test_semantic_voxels_are_the_recorded_ones(log: LogPath, example: Example) -> None:
    truth = example.truth
    assert truth is not None
    assert truth.semantics is not None
    free = VOXEL_CLASSES["occ3d"].index("free")
    labels = recorded_labels(Log(log), 2, OCCUPANCY)
    assert torch.equal(truth.semantics.index != free, labels.occupied)
    assert torch.equal(truth.semantics.known, labels.known)
    for mask in (truth.semantics.camera_mask, truth.semantics.lidar_mask):
        assert 0.05 < mask.float().mean() < 0.9


def test_vehicles_from_above_cover_the_vehicles_boxes(example: Example) -> None:
    assert example.truth is not None
    instances = example.truth.instances
    assert instances is not None
    assert bool(instances.valid.all())
    boxes = example.clip.boxes[0]
    near = (boxes.centre[:, :2].abs() < 49.0).all(dim=-1) & (boxes.category != Category.PEDESTRIAN)
    assert near.any()
    columns, rows = ((boxes.centre[near, axis] + 50.0).div(0.5).long() for axis in (0, 1))
    assert instances.track_id[0, rows, columns].tolist() == (boxes.track_id[near] + 1).tolist()
