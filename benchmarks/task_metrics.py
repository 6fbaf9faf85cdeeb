"""Speed of the tasks' metrics, and what the same predictions score under each protocol.

`foredrive bench task-metrics`; docs/tasks.md shows its figures.
"""

from benchmarks.common import object_speed
from benchmarks.common.benchmark import Benchmark
from benchmarks.common.forecast_scoring import motion_speed
from benchmarks.common.occupancy_scoring import protocols_compared, rayiou_speed

BENCHMARK = Benchmark(
    question="How fast are the tasks' metrics, and how do protocols differ on the same predictions?",
    arms={
        "tracking": object_speed.tracking_speed,
        "detection": object_speed.detection_speed,
        "validation": object_speed.validation_size,
        "object_protocols": object_speed.protocols_compared,
        "rayiou": rayiou_speed,
        "occupancy_protocols": protocols_compared,
        "motion": motion_speed,
    },
    seeds=(0,),
    config={
        "validation": f"{object_speed.FRAMES} frames, {object_speed.FOUND} boxes",
        "devkit": "nuscenes-devkit 1.2.0, where it is installed (make test-oracles)",
    },
)
