"""The synthetic predictions of `bench task-metrics`: what they have in common, and where they differ."""

import numpy as np
import pytest

from benchmarks.common.occupancy_scoring import Frame, frames
from foredrive.tasks.occupancy.protocols import OCC3D_CLASSES, VOXEL_PROTOCOLS
from foredrive.tasks.occupancy.score import count_voxels, mean_iou, voxel_ious

FREE = len(OCC3D_CLASSES) - 1


@pytest.fixture(scope="module")
def frame() -> Frame:
    return next(frames(np.random.default_rng(0), 1, OCC3D_CLASSES))


def test_the_truth_is_what_was_seen(frame: Frame) -> None:
    assert (frame.true[~frame.lidar] == FREE).all()
    assert not (frame.camera & ~frame.lidar).any()
    assert 0.02 < frame.camera.mean() < frame.lidar.mean() < 0.8
    assert (frame.true[frame.camera] != FREE).any()
    assert (frame.true[frame.camera] == FREE).any()


def test_a_camera_mask_does_not_tell_the_predictions_apart(frame: Frame) -> None:
    assert (frame.thick == frame.predicted)[frame.camera].all()
    assert (frame.thick != FREE).sum() > 1.5 * (frame.predicted != FREE).sum()
    scores = [
        mean_iou(voxel_ious(counts, VOXEL_PROTOCOLS["occ3d"]))
        for counts in (
            count_voxels(labels, frame.true, frame.camera, frame.lidar, FREE + 1)
            for labels in (frame.predicted, frame.thick)
        )
    ]
    assert scores[0] == scores[1] > 0.1
