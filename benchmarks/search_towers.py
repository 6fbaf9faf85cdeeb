"""Sweeps that the lidar tower embeds per second: `foredrive bench search-towers`.

The towers are untrained: weights do not change the speed. They embed sweeps of a recorded town, cut into six
sectors, as an index does it: in parallel on every core of this process, with one thread each. "tiny" and
"base" run in a new process each, "tiny_after_recording" in the process that recorded the sweeps. CPU time and
the speed of a matrix product, measured at the same time, tell a slow tower from a busy machine.
"""

import json
import os
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import Took, in_a_process, measure
from foredrive.data import find_logs
from foredrive.data.batches import stack_records
from foredrive.data.logs import Log
from foredrive.methods.lidarclip import LidarEncoder, LidarEncoderConfig, PointCloud
from foredrive.runs.drive.recording import record_plan
from foredrive.scene import LidarSweep
from foredrive.search.crops import Crop
from foredrive.search.embedding import View, read_views
from foredrive.sensors.rigs import SURROUND
from foredrive.towns.campaign import DrivePlan

SWEEPS, REPEATS, DIM, SIDE_PX = 8, 9, 384, 128
PRODUCT = (4096, 128, 256)
"""Rows, inner and outer size of the matrix product: a feed-forward layer of the tower."""
BLOCK_LAYERS = {"tiny": 1, "base": 2}


def record(seed: int, folder: Path) -> None:
    """Record the sweeps in this process."""
    record_plan(DrivePlan("Town05", seed, "clear", 20, 20, SWEEPS / 2, 2.0), folder, SURROUND)


def embed_speed(folder: Path, size: str) -> dict[str, float]:
    """Return the speed of a tower on the sweeps in a folder, and that of the machine."""
    log = Log(find_logs(folder)[0])
    read = [read_views(log, frame, SIDE_PX, Crop.WHOLE, with_lidar=True) for frame in range(len(log.t_us))]
    clouds = [
        PointCloud.from_sweeps(stack_records([_sweep(views[name]) for views in read])) for name in read[0]
    ]
    torch.manual_seed(0)
    tower = LidarEncoder(LidarEncoderConfig(block_layers=BLOCK_LAYERS[size]), dim=DIM).eval()
    rows, inner, outer = PRODUCT
    left, right = torch.randn(rows, inner), torch.randn(inner, outer)

    @torch.inference_mode()
    def embed(_: int) -> None:
        for cloud in clouds:
            tower(cloud, len(read))

    @torch.inference_mode()
    def multiply(_: int) -> None:
        for _ in range(100):
            torch.mm(left, right)

    threads = len(os.sched_getaffinity(0))
    sweeps, products = _in_parallel(embed, threads), _in_parallel(multiply, threads)
    return {
        "sweeps_per_s": threads * len(read) / sweeps.wall_s,
        "sweeps_per_core_s": threads * len(read) / sweeps.cpu_s,
        "matmul_gflops_per_core_s": threads * 100 * 2e-9 * rows * inner * outer / products.cpu_s,
        "cores_used": sweeps.cpu_s / sweeps.wall_s,
        "threads": float(threads),
        "sectors": float(len(clouds)),
        "points_per_sector": sum(len(cloud.points) for cloud in clouds) / len(clouds) / len(read),
    }


def _sweep(view: View) -> LidarSweep:
    assert view.sweep is not None
    return view.sweep


def _in_parallel(work: Callable[[int], None], threads: int) -> Took:
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        list(pool.map(work, range(threads)))
        return measure(lambda: list(pool.map(work, range(threads))), REPEATS, "cpu")


def in_new_process(size: str, seed: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        record(seed, Path(folder))
        return in_a_process(__file__, folder, size)


def after_recording(seed: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        record(seed, Path(folder))
        return embed_speed(Path(folder), "tiny")


BENCHMARK = Benchmark(
    question="How many sweeps does the lidar tower embed per second?",
    arms={
        "tiny": lambda seed: in_new_process("tiny", seed),
        "base": lambda seed: in_new_process("base", seed),
        "tiny_after_recording": after_recording,
    },
    seeds=(0,),
    config={"sweeps": SWEEPS, "repeats": REPEATS, "dim": DIM, "product": PRODUCT},
)

if __name__ == "__main__":
    print(json.dumps(embed_speed(Path(sys.argv[1]), sys.argv[2])))
