"""LidarCLIP's encoder (Hess et al. 2024): lidar sweeps to the embedding space of an image tower."""

from foredrive.models.lidar_clip.encoder import LidarEncoder, LidarEncoderConfig
from foredrive.models.lidar_clip.pillars import PillarGrid, PointCloud

__all__ = ["LidarEncoder", "LidarEncoderConfig", "PillarGrid", "PointCloud"]
