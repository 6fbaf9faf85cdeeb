"""LidarCLIP's encoder (Hess et al. 2024): lidar sweeps to the embedding space of an image tower."""

from foredrive.methods.lidarclip.encoder import LidarEncoder, LidarEncoderConfig
from foredrive.methods.lidarclip.pillars import PillarGrid, PointCloud

__all__ = ["LidarEncoder", "LidarEncoderConfig", "PillarGrid", "PointCloud"]
