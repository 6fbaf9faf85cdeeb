"""Loading of clips from disk, and growth of memory: `foredrive bench loading`.

A town is recorded first. `nemo_tiny` loads from one log at 10 Hz, as `foredrive record` makes it by default.
`nemo_town` draws from forty logs at 2 Hz, copies of one, as a large training set does. A first pass, which is
not measured, makes labels and shrunk images, as training does in its first epoch. `nemo_base` loads six
images of 900 x 1600 pixels a frame on one core, in the first epoch too.
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
from benchmarks.full_size import converted
from foredrive.data import ClipDataset, collate, find_logs
from foredrive.engine.interrupts import start_fork_server
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import Example
from foredrive.towns.recorder import record

TOWN, SECONDS = "Town02", 30.0
WORKERS, BATCH_SIZE, CLIPS, LOGS = 2, 4, 5000, 40
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


def full_size(_: int) -> dict[str, float]:
    """Return the clips of `nemo_base` that a core loads in a second of CPU time.

    The first epoch decodes and shrinks the images and makes the labels, later ones read what it has kept.
    """
    with tempfile.TemporaryDirectory() as cache:
        dataset = ClipDataset([converted()], find_recipe("nemo_base").clips, Path(cache))
        figures = {}
        for key in ("full_size_clips_per_cpu_s", "later_clips_per_cpu_s"):
            began_s = time.process_time()
            for index in range(len(dataset)):
                dataset[index]
            figures[key] = len(dataset) / (time.process_time() - began_s)
    return figures


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
    arms={"nemo_tiny": one_log, "nemo_town": forty_logs, "nemo_base": full_size},
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
