"""Run the demo as a new user does, in a folder of its own, and keep its figures: `foredrive bench demo`.

README's time of the demo is this figure. The folder, runs/demo_benchmark/COMMIT, keeps the report.
"""

import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.study import work_folder
from foredrive.engine.metrics_log import read_metrics
from foredrive.engine.summary import numbers, read_summary

WORK = work_folder(Path("runs/demo_benchmark"))
STAGES = ("pretrain", "finetune")


def demo(seed: int, *options: str) -> Mapping[str, float]:
    """Return time, memory and results of a demo from an empty folder; on one core this is computing time."""
    out = WORK / ("quick" if options else "full")
    shutil.rmtree(out, ignore_errors=True)
    began = time.perf_counter()
    command = [sys.executable, "-m", "foredrive", "demo", "--out", str(out), *options]
    subprocess.run(command, check=True)
    figures = {
        "wall_min": (time.perf_counter() - began) / 60,
        "largest_process_gib": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20,
    }
    return figures | results(out)


def results(out: Path) -> dict[str, float]:
    """Return the figures of a finished demo."""
    figures: dict[str, float] = {}
    for part in ("seen", "learned"):
        summary = numbers(read_summary(out / part / "summary.json"))
        keys = ["items", "failed", "vehicles.car_recall_20m", "vehicles.column_precision_20m"]
        keys += [key for key in summary if key.startswith("occupancy.above_ground.iou_")]
        keys += [f"planning.{planner}uniad.l2_avg_m" for planner in ("", "ego_mlp.")]
        figures |= {f"{part}.{key}": summary[key] for key in keys if key in summary}
    for stage in STAGES:
        steps = read_metrics(out / "learned" / stage / "metrics.jsonl")
        figures[f"learned.{stage}.steps"] = len(steps)
        figures[f"learned.{stage}.min"] = sum(float(step["step_s"]) for step in steps) / 60
    for part in ("driven", "driven_expert"):
        summary = numbers(read_summary(out / part / "summary.json"))
        figures |= {f"{part}.{key}": summary[key] for key in ("driving_score_1_0", "completion")}
    reconstructed = numbers(read_summary(out / "reconstructed" / "summary.json"))
    figures |= {f"rebuilt.{key}": reconstructed[key] for key in ("psnr_db", "nearest.psnr_db", "minutes")}
    improved = numbers(read_summary(out / "improved" / "summary.json"))
    figures |= {
        f"improved.{key}": value for key, value in improved.items() if key.endswith("driving_score_1_0")
    }
    return figures


BENCHMARK = Benchmark(
    question="What does the demo take, and what comes out of it?",
    arms={"full": demo, "quick": lambda seed: demo(seed, "--quick")},
    seeds=(0,),
)
