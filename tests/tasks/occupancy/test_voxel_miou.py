"""Mean IoU of voxels: masks and absent classes by hand, beside torchmetrics and a count voxel by voxel."""

import math

import numpy as np
import pytest
import torch
from torchmetrics.classification import MulticlassJaccardIndex

from foredrive.scene import VoxelSpec
from foredrive.scene.semantics import SemanticVoxels
from foredrive.tasks.occupancy.protocols import OCC3D_CLASSES, VOXEL_PROTOCOLS, VoxelProtocol
from foredrive.tasks.occupancy.score import count_semantics, count_voxels, mean_iou, voxel_ious

C = len(OCC3D_CLASSES)
CAR, ROAD, BUS, FREE = (OCC3D_CLASSES.index(name) for name in ("car", "driveable_surface", "bus", "free"))


def row(*values: int) -> np.ndarray:
    return np.array(values).reshape(1, 1, -1)


def test_each_mask_counts_its_voxels() -> None:
    true = row(CAR, CAR, CAR, CAR, FREE, FREE).astype(np.uint8)
    predicted = row(CAR, FREE, CAR, FREE, CAR, CAR).astype(np.uint8)
    camera = row(1, 1, 0, 0, 0, 1).astype(bool)
    lidar = row(1, 0, 1, 1, 1, 0).astype(bool)
    counts = count_voxels(predicted, true, camera, lidar, C)
    expected = {
        "occ3d": 1 / 3,  # voxels 0, 1, 5: a hit, a missed one, a false one
        "occ3d_lidar": 2 / 4,  # 0, 2, 3, 4: two hits, a missed one, a false one
        "occ3d_both": 1.0,  # voxel 0 alone
        "occ3d_unmasked": 2 / 6,
    }
    found = {name: voxel_ious(counts, VOXEL_PROTOCOLS[name])[CAR] for name in expected}
    assert found == pytest.approx(expected)
    assert mean_iou(voxel_ious(counts, VOXEL_PROTOCOLS["occ3d"])) == pytest.approx(1 / 3)  # without free


def test_a_class_that_the_truth_lacks_counts_zero_or_not_at_all() -> None:
    """A bus predicted where there is none lowers Occ3D's mean; SparseOcc leaves the class out."""
    true, predicted = row(CAR, CAR, CAR).astype(np.uint8), row(CAR, CAR, BUS).astype(np.uint8)
    seen = np.ones(true.shape, bool)
    counts = count_voxels(predicted, true, seen, seen, C)
    ious = {name: voxel_ious(counts, VOXEL_PROTOCOLS[name]) for name in ("occ3d", "sparseocc")}
    assert ious["occ3d"][BUS] == 0.0
    assert math.isnan(ious["sparseocc"][BUS])
    assert math.isnan(ious["occ3d"][ROAD])
    assert mean_iou(ious["occ3d"]) == pytest.approx(0.5 * 2 / 3)
    assert mean_iou(ious["sparseocc"]) == pytest.approx(2 / 3)


def test_sums_over_frames_before_the_ratio() -> None:
    seen = np.ones((1, 1, 4), bool)
    first = count_voxels(
        row(CAR, CAR, CAR, CAR).astype(np.uint8), row(CAR, CAR, CAR, CAR).astype(np.uint8), seen, seen, C
    )
    second = count_voxels(
        row(CAR, FREE, FREE, FREE).astype(np.uint8),
        row(FREE, CAR, FREE, FREE).astype(np.uint8),
        seen,
        seen,
        C,
    )
    assert voxel_ious(first + second, VOXEL_PROTOCOLS["occ3d"])[CAR] == pytest.approx(4 / 6)


def test_voxels_without_truth_are_not_counted() -> None:
    spec = VoxelSpec((0.0, 0.0, 0.0), 0.4, (1, 1, 4))
    true, predicted = (torch.tensor(row(*v), dtype=torch.uint8) for v in ((CAR,) * 4, (CAR, CAR, FREE, FREE)))
    known, camera = torch.tensor(row(1, 1, 1, 0) > 0), torch.tensor(row(1, 0, 1, 0) > 0)
    counts = count_semantics(predicted, SemanticVoxels(spec, "occ3d", true, known, camera, known))
    assert counts.sum() == 3
    ious = [voxel_ious(counts, VOXEL_PROTOCOLS[name])[CAR] for name in ("occ3d_unmasked", "occ3d")]
    assert ious == pytest.approx([2 / 3, 1 / 2])


def voxel_by_voxel(
    frames: list[tuple[np.ndarray, ...]], protocol: VoxelProtocol
) -> tuple[list[float], float]:
    """The IoUs, one voxel at a time."""
    hit, true_count, predicted_count = [0] * C, [0] * C, [0] * C
    for predicted, true, camera, lidar in frames:
        for p, t, c, k in zip(predicted.flat, true.flat, camera.flat, lidar.flat, strict=True):
            if ("camera" in protocol.masks and not c) or ("lidar" in protocol.masks and not k):
                continue
            true_count[t] += 1
            predicted_count[p] += 1
            hit[t] += p == t
    ious = []
    for k in range(C):
        missing = (
            true_count[k] == 0 if protocol.absent == "in truth" else true_count[k] + predicted_count[k] == 0
        )
        either = true_count[k] + predicted_count[k] - hit[k]
        ious.append(math.nan if missing else hit[k] / either)
    kept = [iou for iou in ious[:-1] if not math.isnan(iou)]
    return ious, sum(kept) / len(kept)


def random_frames(rng: np.random.Generator, number: int) -> list[tuple[np.ndarray, ...]]:
    """Frames whose truth lacks two classes, one of which the prediction has."""
    frames = []
    for _ in range(number):
        true = rng.choice([k for k in range(C) if k not in (3, 5)], (3, 8, 8)).astype(np.uint8)
        predicted = np.where(rng.random(true.shape) < 0.6, true, rng.choice(17, true.shape))
        predicted[predicted == 3] = FREE
        frames.append(
            (predicted.astype(np.uint8), true, rng.random(true.shape) < 0.6, rng.random(true.shape) < 0.7)
        )
    return frames


@pytest.mark.parametrize("name", [name for name, p in VOXEL_PROTOCOLS.items() if p.classes == OCC3D_CLASSES])
def test_random_voxels_as_counted_one_by_one(name: str) -> None:
    frames, protocol = random_frames(np.random.default_rng(3), 4), VOXEL_PROTOCOLS[name]
    ious = voxel_ious(sum(count_voxels(*frame, C) for frame in frames), protocol)
    expected, mean = voxel_by_voxel(frames, protocol)
    assert ious.tolist() == pytest.approx(expected, nan_ok=True, abs=1e-12)
    assert mean_iou(ious) == pytest.approx(mean, abs=1e-12)


def test_torchmetrics_agrees_where_all_classes_occur() -> None:
    rng = np.random.default_rng(4)
    jaccard, counts = MulticlassJaccardIndex(num_classes=C, average=None), np.zeros((2, 2, C, C), np.int64)
    for _ in range(3):
        true, predicted = (rng.integers(0, C, (4, 10, 10)).astype(np.uint8) for _ in range(2))
        camera, lidar = (rng.random(true.shape) < 0.5 for _ in range(2))
        counts += count_voxels(predicted, true, camera, lidar, C)
        jaccard.update(torch.from_numpy(predicted[camera]).long(), torch.from_numpy(true[camera]).long())
    ours = voxel_ious(counts, VOXEL_PROTOCOLS["occ3d"])
    assert ours.tolist() == pytest.approx(jaccard.compute().tolist(), abs=1e-6)
