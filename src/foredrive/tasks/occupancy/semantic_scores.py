"""Mean IoU of semantic voxels, under any mask."""

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from numpy import ndarray
from torch import Tensor

from foredrive.scene.semantics import VOXEL_CLASSES, SemanticVoxels
from foredrive.tasks.objects.matching import mean_of_valid
from foredrive.tasks.occupancy.protocols import VoxelProtocol


def count_voxels(
    predicted: UInt8[ndarray, "*voxels"],
    true: UInt8[ndarray, "*voxels"],
    seen_by_camera: Bool[ndarray, "*voxels"],
    seen_by_lidar: Bool[ndarray, "*voxels"],
    classes: int,
) -> Int64[ndarray, "2 2 C C"]:
    """Count voxels by: seen by a camera, seen by the lidar, true class, predicted class.

    The counts of frames add up, and every protocol sums those of its masks.
    """
    # One number for each combination of masks and classes
    cell = (seen_by_camera.astype(np.int64) * 2 + seen_by_lidar) * classes + true
    counts = np.bincount((cell * classes + predicted).ravel(), minlength=4 * classes * classes)
    return counts.astype(np.int64).reshape(2, 2, classes, classes)


def count_semantics(predicted: UInt8[Tensor, "*b Z Y X"], truth: SemanticVoxels) -> Int64[ndarray, "2 2 C C"]:
    """Count the known voxels of a batch likewise. Where there is no truth, no protocol can judge."""
    known = truth.known.cpu().numpy()
    labels, true, camera, lidar = (
        part.cpu().numpy()[known] for part in (predicted, truth.index, truth.camera_mask, truth.lidar_mask)
    )
    return count_voxels(labels, true, camera, lidar, len(VOXEL_CLASSES[truth.taxonomy]))


def voxel_ious(counts: Int64[ndarray, "2 2 C C"], protocol: VoxelProtocol) -> Float64[ndarray, "C"]:
    """Return the IoU of each class, free among them; NaN for classes that the protocol leaves out."""
    # A protocol without a mask sums over both values of it
    by_camera = counts[1:] if "camera" in protocol.masks else counts
    counted = by_camera[:, 1:] if "lidar" in protocol.masks else by_camera
    table = counted.sum(axis=(0, 1))
    # Diagonal: right voxels; rows: truth; columns: prediction
    hits, true, predicted = np.diag(table), table.sum(axis=1), table.sum(axis=0)
    either = true + predicted - hits
    known = true > 0 if protocol.absent == "in truth" else either > 0
    return np.divide(hits, either, out=np.full(len(hits), np.nan), where=known)


def mean_iou(ious: Float64[ndarray, "*T C"]) -> float:
    """Return the mean over all classes but the last, which is free, and over thresholds; without NaN."""
    return mean_of_valid(ious[..., :-1].ravel().tolist())
