"""A small recording of a town, which several files of tests read."""

from pathlib import Path

from foredrive.data.log_paths import LogPath
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.recorder import LabelOptions, record
from foredrive.towns.sensing.capture import SensorSuite

FRAMES = 5
RATE_HZ = 2.0


def record_small(out: Path, seed: int = 3, town: str = "Town02") -> LogPath:
    sensors = SensorSuite(camera_rig((36, 64)), roof_lidar(channels=16, azimuth_steps=180))
    labels = LabelOptions(depth=True, semantic=True, instance=True)
    return record(
        town,
        FRAMES / RATE_HZ,
        seed,
        out,
        RATE_HZ,
        sensors,
        BackgroundTraffic(vehicles=12, pedestrians=8),
        labels,
    )
