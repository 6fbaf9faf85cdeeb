"""A corpus of 100,000 key frames, opened and loaded, and what each step of the loop costs a core.

The corpus is one recorded log of a town in 2,500 folders: hard links to the same files. Its cache of
labels and shrunk images is linked too, so that it takes 100 MB of disk and not 30 GB. Names, folders and
opened files are as many as in a real corpus. The speed of the disk is not measured, because the pages are in
memory.

The rates are of CPU time, of all threads and child processes, so they are those of one core. A rate that is
not measured here stands in the results of another benchmark (docs/scale.md).
"""

import contextlib
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from benchmarks.common.benchmark import Benchmark
from benchmarks.loading import BATCH_SIZE, CLIPS, WORKERS, load_clips
from foredrive.data import ClipDataset, LogPath, find_logs
from foredrive.data.disk_cache import entry_file
from foredrive.data.logs import Log
from foredrive.runs.evaluate.run import evaluate_run
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.search.indexing import index_logs
from foredrive.runs.train.run import train_run
from foredrive.towns.recorder import record

ROOT = Path("runs/scale").absolute()
TOWN, SECONDS, RATE_HZ = "Town02", 20.0, 2.0
"""The recorded log: as long as a scene of nuScenes, at its rate of key frames."""
KEY_FRAMES, RECIPE = 100_000, "nemo_town"
STEPS = 40
"""Training steps that are measured."""


def corpus(seed: int) -> dict[str, float]:
    """Open the corpus and load random clips of it."""
    with _recorded(seed) as log:
        clips = find_recipe(RECIPE).clips
        frames = round(SECONDS * RATE_HZ)
        logs = [log, *(_linked(log, copy) for copy in range(1, KEY_FRAMES // frames))]
        one = ClipDataset([log], clips, ROOT / "cache")
        for index in range(len(one)):  # makes labels and shrinks images
            one[index]
        started, cpu_s = time.perf_counter(), time.process_time()
        found = find_logs(ROOT / "data")
        dataset = ClipDataset(found, clips, ROOT / "cache")
        figures = {"open_s": time.perf_counter() - started, "open_cpu_s": time.process_time() - cpu_s}
        assert len(found) == len(logs)
        _link_cache(dataset, logs)
        loading = load_clips(dataset)
    grown = loading["rss_growth_mib"] / (loading["rss_mib"] - loading["rss_growth_mib"])
    return {
        "key_frames": float(frames * len(logs)),
        "clips": float(len(dataset)),
        **figures,
        "clips_per_s": loading["clips_per_s"],
        "memory_mib": loading["rss_mib"],
        "memory_growth_pct": 100 * grown,
    }


def rates(seed: int) -> dict[str, float]:
    """Measure what a core records, trains, evaluates and indexes."""
    torch.set_num_threads(1)
    began_s = time.process_time()
    with _recorded(seed) as log:
        frames = SECONDS * RATE_HZ
        figures = {"record_frames_per_cpu_s": frames / (time.process_time() - began_s)}
        recipe = find_recipe(
            RECIPE,
            [f"pretrain.schedule.steps={STEPS}", f"finetune.schedule.steps={STEPS}"]
            + [f"{stage}.schedule.workers=0" for stage in ("pretrain", "finetune")],
        )
        clips = ClipDataset([log], recipe.clips, ROOT / "cache")
        began_s = time.process_time()
        for index in range(len(clips)):
            clips[index]
        figures["first_load_clips_per_cpu_s"] = len(clips) / (time.process_time() - began_s)
        began_s = time.process_time()
        run = train_run(recipe, [log], ROOT / "run", ROOT / "cache")
        seen = STEPS * sum(stage.schedule.batch_size for stage in (recipe.pretrain, recipe.finetune) if stage)
        figures["train_clips_per_cpu_s"] = seen / (time.process_time() - began_s)
        began_s = time.process_time()
        items = evaluate_run(run, [log], ROOT / "evaluation").summary["items"]
        assert isinstance(items, int)
        figures["evaluate_clips_per_cpu_s"] = items / (time.process_time() - began_s)
        index_logs([log], str(ROOT / "warm"), "embedded", SECONDS, 1)
        began_s = time.process_time()
        index_logs([log], str(ROOT / "index"), "embedded", 1 / RATE_HZ, 1)
        figures["index_moments_per_cpu_s"] = frames / (time.process_time() - began_s)
    return figures


@contextlib.contextmanager
def _recorded(seed: int) -> Iterator[LogPath]:
    """Record the log in an empty folder, and remove everything at the end."""
    shutil.rmtree(ROOT, ignore_errors=True)
    try:
        yield record(TOWN, SECONDS, seed, ROOT / "data", RATE_HZ)
    finally:
        shutil.rmtree(ROOT, ignore_errors=True)


def _linked(log: LogPath, copy: int) -> LogPath:
    folder = log.folder.with_name(f"{log.folder.name}_{copy}")
    shutil.copytree(log.folder, folder, copy_function=os.link)
    return LogPath(folder, log.maps_dir)


def _link_cache(dataset: ClipDataset, logs: list[LogPath]) -> None:
    """Give all logs the cache entries of the first one, as if each had been read once."""
    cameras = [dataset._cameras[0][name] for name in dataset.camera_names]
    opened = {log.path.folder: log for log in dataset.logs}

    def entries(log: Log, frame: int) -> Iterator[Path]:
        frames = (dataset._frames._key(log, cameras), frame)
        yield entry_file(ROOT / "cache" / "frames", frames, "frame")
        yield entry_file(ROOT / "cache" / "labels", dataset._labels._key(log, frame), "labels")

    first = opened[logs[0].folder]
    for frame in range(len(first)):
        for log in logs[1:]:
            for source, entry in zip(entries(first, frame), entries(opened[log.folder], frame), strict=True):
                if source.is_file():
                    entry.parent.mkdir(parents=True, exist_ok=True)
                    os.link(source, entry)


BENCHMARK = Benchmark(
    question="How fast do 100,000 key frames open and load, is memory flat, and what does one core do?",
    arms={"corpus": corpus, "rates": rates},
    seeds=(0,),
    config={
        "town": TOWN,
        "seconds": SECONDS,
        "rate_hz": RATE_HZ,
        "key_frames": KEY_FRAMES,
        "recipe": RECIPE,
        "workers": WORKERS,
        "batch_size": BATCH_SIZE,
        "clips": CLIPS,
        "steps": STEPS,
    },
)
