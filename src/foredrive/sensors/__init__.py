"""Camera and lidar models: pixels and beams to timed rays."""

from foredrive.sensors.camera import camera_rays, readout_time_s
from foredrive.sensors.lidar import SpinningLidar
from foredrive.sensors.rays import TimedRays

__all__ = ["SpinningLidar", "TimedRays", "camera_rays", "readout_time_s"]
