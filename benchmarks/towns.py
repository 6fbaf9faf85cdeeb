"""Speed of sensing and recording towns, growth of memory, and profile: `foredrive bench towns`.

It uses six cameras of 144×256 px and 32×720 beams among 60 actors.
"""

import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from types import CodeType, FrameType, ModuleType
from typing import Any, TypeVar

import torch
from py123d.common.io.camera import jpeg_camera_io

from benchmarks.common.benchmark import Benchmark
from foredrive.data.log_writer import LogWriter
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns import recorder
from foredrive.towns.labels import captions, frame_facts, occupancy, semantics, visibility
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.recorder import record
from foredrive.towns.sensing import capture, raycast
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic import expert
from foredrive.towns.traffic.expert import ExpertDrive
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.world import World

TOWN, VEHICLES, PEOPLE, RATE_HZ = "Town05", 40, 20, 2.0
FRAMES = 60
LONG_RUN_S = 3600.0
"""Length of the drive in the memory test, s."""
SETTLED_FROM, ENDS_FROM = 0.1, 0.9
"""Shares of a run between which memory is compared; before the first, caches fill."""
SAMPLE_S = 0.005

FRAMES_ARE_MADE = (recorder._sense, recorder._frame, LogWriter.write)
"""A sample without one of these functions in its stack is of the start of a recording."""
PARTS: tuple[tuple[str, Any], ...] = (
    ("traffic", expert),
    ("jpeg", jpeg_camera_io),
    ("arrow", LogWriter.write),
    ("labels", frame_facts),
    ("labels", occupancy),
    ("labels", visibility),
    ("labels", semantics),
    ("labels", captions),
    ("lidar", capture.simulate_sweep),
    ("casting", raycast),
    ("shading", capture),
)
"""Names of parts, each with a module or function. A sample counts for the first that its stack contains."""


def sensors(seed: int) -> dict[str, float]:
    """Measure key frames per second without labels and disk."""
    town = load_town_map(TOWN)
    world, traffic = World(town, seed), Traffic(town, seed, VEHICLES + 1, PEOPLE)
    moments = list(ExpertDrive(traffic, FRAMES / RATE_HZ).snapshots(FRAMES + 1, 1 / RATE_HZ))
    suite = _suite()

    def render(first: int, last: int) -> float:
        started = time.perf_counter()
        for index, m in enumerate(moments[first:last]):
            world.render(m.actors, suite, m.T_world_ego, m.twist_ego, noise_seed=index, lights=m.lights)
        return time.perf_counter() - started

    render(0, 1)  # compiles
    return {
        "sensor_hz": FRAMES / render(1, FRAMES + 1),
        "road_users": sum(len(m.actors) for m in moments) / len(moments),
        "threads": torch.get_num_threads(),
    }


def disk(seed: int) -> dict[str, float]:
    """Measure key frames per second into a log with all labels of `foredrive record`, and the start time."""
    _record(seed, 1)  # compiles
    took_s = {frames: _record(seed, frames) for frames in (FRAMES // 4, FRAMES)}
    write_hz = (FRAMES - FRAMES // 4) / (took_s[FRAMES] - took_s[FRAMES // 4])
    return {"write_hz": write_hz, "start_s": took_s[FRAMES] - FRAMES / write_hz}


def memory(seed: int) -> dict[str, float]:
    """Measure memory over one long drive, swapped out or not, without pages of files, MiB."""
    with _sampled(1.0, _resident_mib) as samples:
        _record(seed, round(LONG_RUN_S * RATE_HZ))
    settled = samples[int(SETTLED_FROM * len(samples)) : int(2 * SETTLED_FROM * len(samples)) + 1]
    end = median(samples[int(ENDS_FROM * len(samples)) :])
    return {"rss_mib": end, "rss_growth_mib": end - median(settled)}


def profile(seed: int) -> dict[str, float]:
    """Return the share of recording time of each part, on one thread."""
    _record(seed, 1)  # compiles
    threads, main = torch.get_num_threads(), threading.get_ident()
    torch.set_num_threads(1)
    try:
        with _sampled(SAMPLE_S, lambda: _part(sys._current_frames()[main])) as samples:
            _record(seed, FRAMES)
    finally:
        torch.set_num_threads(threads)
    while samples and samples[0] == "start":
        samples.pop(0)
    found = Counter(part for part in samples if part != "start")
    names = dict.fromkeys([name for name, _ in PARTS] + ["rest"])
    return {f"{name}_share": found[name] / found.total() for name in names}


def _record(seed: int, frames: int) -> float:
    """Return the time of a recording, s."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        record(
            TOWN, frames / RATE_HZ, seed, Path(folder), RATE_HZ, _suite(), BackgroundTraffic(VEHICLES, PEOPLE)
        )
    return time.perf_counter() - started


def _suite() -> SensorSuite:
    return SensorSuite(camera_rig((144, 256)), roof_lidar())


T = TypeVar("T")


@contextmanager
def _sampled(every_s: float, take: Callable[[], T]) -> Iterator[list[T]]:
    """Collect the results of `take` every `every_s` while the block runs."""
    samples, over = list[T](), threading.Event()

    def watch() -> None:
        while not over.wait(every_s):
            samples.append(take())

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield samples
    finally:
        over.set()
        thread.join()


def _part(frame: FrameType | None) -> str:
    """Return the part that a stack works on."""
    stack = set[CodeType | str]()
    while frame is not None:
        stack |= {frame.f_code, frame.f_code.co_filename}
        frame = frame.f_back
    if stack.isdisjoint(function.__code__ for function in FRAMES_ARE_MADE):
        return "start"
    for part, place in PARTS:
        if (place.__file__ if isinstance(place, ModuleType) else place.__code__) in stack:
            return part
    return "rest"


def _resident_mib() -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith(("RssAnon:", "VmSwap:"))) / 1024


BENCHMARK = Benchmark(
    question="How many key frames per second does a town give, is memory flat, and where does the time go?",
    arms={"sensors": sensors, "disk": disk, "memory": memory, "profile": profile},
    seeds=(0,),
    config={
        "town": TOWN,
        "vehicles": VEHICLES,
        "people": PEOPLE,
        "rate_hz": RATE_HZ,
        "frames": FRAMES,
        "long_run_s": LONG_RUN_S,
    },
)
