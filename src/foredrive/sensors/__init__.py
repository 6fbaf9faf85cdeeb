"""Camera and lidar models: they turn pixels and beams into timed rays."""

from foredrive.sensors.camera import camera_rays, readout_time_s
from foredrive.sensors.lidar import SpinningLidar
from foredrive.sensors.lidar_models import hdl32e, pandar64, vlp16
from foredrive.sensors.optics import CameraOptics
from foredrive.sensors.rays import TimedRays

__all__ = [
    "CameraOptics",
    "SpinningLidar",
    "TimedRays",
    "camera_rays",
    "hdl32e",
    "pandar64",
    "readout_time_s",
    "vlp16",
]
