"""Truth for metrics of rays: the places of a drive's lidar, and the true velocities of voxels."""

import numpy as np
import torch
from jaxtyping import Float64
from py123d.datatypes import LidarMergedMetadata, LidarMetadata

from foredrive.data.logs import Log
from foredrive.data.recorded import read_occupancy
from foredrive.data.recorded_labels import resampled_labels
from foredrive.scene import VoxelSpec
from foredrive.scene.semantics import RayTruth
from foredrive.sensors.ray_origins import MAX_ORIGINS, ray_origins


def read_rays(log: Log, frame: int, spec: VoxelSpec) -> RayTruth:
    """Read the truth of a frame, unbatched.

    Without lidar no origin is valid. Without a recording all voxels stand still.

    Raises:
        InputError: the recorded voxels cannot be read.
    """
    origin, valid = torch.zeros(MAX_ORIGINS, 3), torch.zeros(MAX_ORIGINS, dtype=torch.bool)
    T_ego_lidar = lidar_pose(log)
    if T_ego_lidar is not None:
        # The mount is the same at all frames
        mounted = np.broadcast_to(T_ego_lidar, (len(log), 4, 4))
        places = torch.from_numpy(ray_origins(log.T_world_ego, mounted, frame)).float()
        origin[: len(places)], valid[: len(places)] = places, True
    recorded = read_occupancy(log, frame)
    if recorded is None:
        return RayTruth(origin, valid, torch.zeros(2, *spec.shape_zyx))
    # Over ground: x and y
    return RayTruth(origin, valid, resampled_labels(recorded, spec).flow_mps[:2])


def lidar_pose(log: Log) -> Float64[np.ndarray, "4 4"] | None:
    """Return `T_ego_lidar` of the first lidar of a log, or None if it has none."""
    for metadata in log.scene.get_all_modality_metadatas().values():
        if isinstance(metadata, LidarMergedMetadata):
            metadata = next(iter(metadata.lidar_metadatas.values()))
        if isinstance(metadata, LidarMetadata):
            pose: Float64[np.ndarray, "4 4"] = metadata.lidar_to_imu_se3.transformation_matrix
            # Lidar poses are relative to the IMU: bring them to the ego frame
            return np.linalg.inv(log.T_imu_ego) @ pose
    return None
