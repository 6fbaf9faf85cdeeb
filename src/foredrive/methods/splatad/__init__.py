"""Scenes of 3-D Gaussians and their projection by cameras and lidars."""

from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.splatad.beams import scan_times, tiled_lidar_beams
from foredrive.methods.splatad.camera import project_camera
from foredrive.methods.splatad.lidar import project_lidar

__all__ = ["Gaussians", "project_camera", "project_lidar", "scan_times", "tiled_lidar_beams"]
