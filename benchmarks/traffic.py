"""Errors in hours of simulated traffic in every town, and the time of a step: `foredrive bench traffic`.

There are 60 actors around the expert, some of them pedestrians; its steering is disturbed now and then.
"""

import functools
import time
from collections.abc import Mapping

import numpy as np

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.traffic_audit import Audit
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.names import TOWNS
from foredrive.towns.traffic.expert import ExpertDrive
from foredrive.towns.traffic.traffic import Traffic

VEHICLES, PEOPLE = 40, 20
HOURS = 1.0
DT_S = 0.1
STEERING_NOISE_RAD = 0.02
CHUNK_S = 900.0
"""Length of a drive along one route, s; then the next route begins."""


def measure(seed: int, town: str, hours: float = HOURS) -> Mapping[str, float]:
    """Return violations, lane changes and kilometres of the expert per simulated hour, and ms per step."""
    town_map = load_town_map(town)
    found: dict[str, float] = {}
    seconds, changes, driven_m, speeds, took_s = 0.0, 0, 0.0, [], []
    for drive_index in range(max(1, round(hours * 3600 / CHUNK_S))):
        length_s = min(CHUNK_S, hours * 3600)
        traffic = Traffic(town_map, 1000 * seed + drive_index, VEHICLES, PEOPLE)
        drive, audit = ExpertDrive(traffic, length_s, STEERING_NOISE_RAD), Audit(town_map, traffic)
        for _ in range(round(length_s / DT_S)):
            before, started = drive.state, time.perf_counter()
            drive.step(DT_S)
            took_s.append(time.perf_counter() - started)
            state = drive.state
            audit.watch(before, state, drive.poses())
            driven_m += DT_S * float(state.vehicles.speed_mps[0])
            speeds.append(float(state.vehicles.speed_mps[state.vehicles.active].mean()))
        for name, count in audit.counts.items():
            found[name] = found.get(name, 0.0) + count
        changes += audit.lane_changes
        seconds += length_s
    per_hour = 3600 / seconds
    figures = {f"{name}_per_h": count * per_hour for name, count in found.items()}
    return figures | {
        "hours": seconds / 3600,
        "lane_changes_per_h": changes * per_hour,
        "expert_kmph": 3.6 * driven_m / seconds,
        "mean_speed_mps": float(np.mean(speeds)),
        "step_ms": 1e3 * float(np.median(took_s)),
    }


BENCHMARK = Benchmark(
    question="What goes wrong in hours of traffic in each town, and what does a step cost?",
    arms={town: functools.partial(measure, town=town) for town in TOWNS},
    seeds=(0,),
    config={
        "vehicles": VEHICLES,
        "people": PEOPLE,
        "hours": HOURS,
        "dt_s": DT_S,
        "steering_noise_rad": STEERING_NOISE_RAD,
    },
)
