"""Scenes of 3-D Gaussians and their projection by cameras and lidars."""

from foredrive.rendering.gaussians.beams import tiled_lidar_beams
from foredrive.rendering.gaussians.camera import project_camera
from foredrive.rendering.gaussians.gaussians import Gaussians
from foredrive.rendering.gaussians.lidar import project_lidar

__all__ = ["Gaussians", "project_camera", "project_lidar", "tiled_lidar_beams"]
