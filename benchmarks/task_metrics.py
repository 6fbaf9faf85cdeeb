"""Speed of the tasks' metrics, and what the same predictions score under each protocol.

`foredrive bench task-metrics`; docs/tasks.md shows its figures.
"""

from benchmarks.common.forecast_scoring import motion_speed
from benchmarks.common.occupancy_scoring import protocols_compared, rayiou_speed
from foredrive.evaluation.bench import Benchmark

BENCHMARK = Benchmark(
    question="How fast are the tasks' metrics, and how do protocols differ on the same predictions?",
    arms={"rayiou": rayiou_speed, "occupancy_protocols": protocols_compared, "motion": motion_speed},
    seeds=(0,),
)
