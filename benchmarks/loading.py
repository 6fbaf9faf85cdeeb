"""Loading of clips from disk, and growth of memory: `foredrive bench loading`.

A town is recorded first. `nemo_tiny` loads from one log at 10 Hz, as `foredrive record` makes it by default.
`nemo_town` draws from forty logs at 2 Hz, copies of one, as a large training set does. A first pass, which is
not measured, makes labels and shrunk images, as training does in its first epoch.
"""

import itertools
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from torch.utils.data import DataLoader

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.process_tree import tree_use
from foredrive.data import CameraSpec, ClipDataset, LogPath, collate, find_logs, write_log
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.engine.interrupts import start_fork_server
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import Example
from foredrive.sensors.rigs import SURROUND, camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.recorder import record
from foredrive.towns.sensing.capture import SensorSuite

TOWN, SECONDS = "Town02", 30.0
WORKERS, BATCH_SIZE, CLIPS, LOGS = 2, 4, 5000, 40
FULL_HW, FULL_SIZE_S = (900, 1600), 10.0
COUNTED_FROM = 0.2
"""Share of the clips after which memory is compared; before it, caches of the libraries fill."""


def one_log(seed: int) -> dict[str, float]:
    """Return the figures of clips of one log."""
    with tempfile.TemporaryDirectory() as folder:
        log = record(TOWN, SECONDS, seed, Path(folder))
        return _measure(ClipDataset([log], find_recipe("nemo_tiny").clips, Path(folder, "cache")))


def forty_logs(seed: int) -> dict[str, float]:
    """Return the figures of clips of many logs in random order."""
    with tempfile.TemporaryDirectory() as folder:
        log = record(TOWN, SECONDS, seed, Path(folder), rate_hz=2.0)
        for copy in range(1, LOGS):
            there = log.folder.with_name(f"{log.folder.name}_{copy}")
            shutil.copytree(log.folder, there, copy_function=os.link)
        logs = find_logs(Path(folder))
        return _measure(ClipDataset(logs, find_recipe("nemo_town").clips, Path(folder, "cache")))


def full_size(seed: int) -> dict[str, float]:
    """Return the clips of `nemo_base` that a core loads in a second, by its CPU time.

    The log has six cameras of 900 x 1600 pixels and a lidar at 2 Hz, as nuScenes' key frames do. The first
    epoch decodes and shrinks the images and makes the labels, the later ones read what it has kept.
    """
    clips = find_recipe("nemo_base").clips
    with tempfile.TemporaryDirectory() as folder:
        dataset = ClipDataset([nuscenes_like(Path(folder), seed)], clips, Path(folder, "cache"))
        figures = {}
        for epoch in ("first", "later"):
            began_s = time.process_time()
            for index in range(len(dataset)):
                dataset[index]
            figures[f"{epoch}_clips_per_cpu_s"] = len(dataset) / (time.process_time() - began_s)
    return figures | {"full_size_clips_per_cpu_s": figures["first_clips_per_cpu_s"]}


def nuscenes_like(folder: Path, seed: int) -> LogPath:
    """Write a drive through a town with images of nuScenes' size, enlarged from smaller ones."""
    sensors = SensorSuite(camera_rig(plan=SURROUND.of_size((225, 400))), roof_lidar())
    small = Log(record(TOWN, FULL_SIZE_S, seed, folder / "small", rate_hz=2.0, sensors=sensors))
    frames, specs, images = range(len(small)), [], {}
    for name, camera in pinhole_cameras(small).items():
        row = [read_camera(small, frame, camera, FULL_HW, True) for frame in frames]
        K, T_ego_cam = row[0].K.double().numpy(), row[0].T_ego_cam.double().numpy()
        specs.append(CameraSpec(name, K, T_ego_cam, FULL_HW))
        images[name] = [shown.image.permute(1, 2, 0).numpy() for shown in row if shown.image is not None]
    sweeps = [seen[0] for frame in frames if (seen := read_sweep(small, frame)) is not None]
    t_s, T_world_ego = (small.t_us - small.t_us[0]) * 1e-6, small.T_world_ego
    return write_log(folder, "full", t_s, T_world_ego, cameras=specs, images=images, sweeps=sweeps)


def _measure(dataset: ClipDataset) -> dict[str, float]:
    for index in range(len(dataset)):
        dataset[index]
    return load_clips(dataset)


def load_clips(dataset: ClipDataset) -> dict[str, float]:
    """Return clips per second, and the memory of this process and its workers and its growth, MiB."""
    loaded, memory_mib = 0, []
    started = time.perf_counter()
    for batch in _batches(dataset):
        loaded += len(batch.key)
        memory_mib.append((loaded, tree_use(os.getpid()).memory_mib))
        if loaded >= CLIPS:
            break
    took_s = time.perf_counter() - started
    settled_mib = next(mib for count, mib in memory_mib if count >= COUNTED_FROM * CLIPS)
    return {
        "clips_per_s": loaded / took_s,
        "rss_mib": memory_mib[-1][1],
        "rss_growth_mib": memory_mib[-1][1] - settled_mib,
    }


def _batches(dataset: ClipDataset) -> Iterator[Example]:
    """Yield batches, epoch after epoch, from the same workers."""
    start_fork_server(preload=type(dataset).__module__)
    loader = DataLoader(
        dataset,
        batch_size=BATCH_SIZE,
        shuffle=True,
        collate_fn=collate,
        num_workers=WORKERS,
        multiprocessing_context="forkserver",
        persistent_workers=True,
    )
    for _ in itertools.count():
        yield from loader


BENCHMARK = Benchmark(
    question="How many clips per second do two workers load, and is their memory flat?",
    arms={"nemo_tiny": one_log, "nemo_town": forty_logs, "full_size": full_size},
    seeds=(0,),
    config={
        "town": TOWN,
        "seconds": SECONDS,
        "logs": LOGS,
        "workers": WORKERS,
        "batch_size": BATCH_SIZE,
        "clips": CLIPS,
    },
)
