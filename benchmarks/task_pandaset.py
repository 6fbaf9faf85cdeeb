"""Task heads on one real log: `foredrive bench task-pandaset`, some minutes on two cores.

The frozen world model comes with the package and has seen towns alone. Heads of detection and motion are
trained on the first four seconds of PandaSet's log 002 (40 frames), and judged on the rest (1.6 s) of the
same street, with the same cars: this shows that heads learn from real data, not that they generalise. Key
frames before the first judged ones, and the true futures of the last training frames, lie across the cut.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

from torch.utils.data import DataLoader

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.study import pandaset_log
from benchmarks.task_probes import kept_figures
from foredrive.data import ClipDataset, collate
from foredrive.engine.summary import numbers
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.recipes.task_heads import town_heads
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.run import load_agent, open_run
from foredrive.runs.train.tasks import probe_run, train_heads
from foredrive.tasks.detection.detection_metric import DetectionMetric
from foredrive.tasks.evaluation.run import evaluate
from foredrive.tasks.motion.motion_metric import MotionMetric
from foredrive.tasks.tracking.tracking_metric import TrackingMetric

ROOT = Path("runs/task_pandaset")
TRAIN_S, JUDGE_S = (0.0, 4.0), (4.0, 6.0)
STRIDE_S, STEPS = 0.1, 200


def nemo_town(seed: int) -> Mapping[str, float]:
    """Train heads on the first part of the log; return the figures of the rest."""
    log = pandaset_log(ROOT / "data")
    start = open_run(run_folder(Path("embedded:nemo_town")))
    seen = [dataclasses.replace(log, parts_s=(TRAIN_S,))]
    run = probe_run(start.recipe, seen, ROOT / f"seed{seed}", ROOT / "cache", start.folder)
    heads = town_heads(("detection", "motion"))
    schedule = dataclasses.replace(heads.schedule, steps=STEPS, seed=seed)
    found = train_heads(run, dataclasses.replace(heads, schedule=schedule, now_stride_s=STRIDE_S))
    clips = dataclasses.replace(
        run.recipe.clips, future_frames=0, tasks=heads.truth, now_stride_s=STRIDE_S, future_images=False
    )
    rest = ClipDataset([dataclasses.replace(log, parts_s=(JUDGE_S,))], clips, run.cache_dir)
    result = evaluate(
        AgentPredictor(load_agent(run), 0, ray_stride=0, heads=found.heads),
        DataLoader(rest, batch_size=4, collate_fn=collate),
        frame_dt_s=clips.frame_dt_s,
        metrics=[DetectionMetric, TrackingMetric, MotionMetric],
    )
    summary = numbers(result.summary)
    return kept_figures(summary) | {key: summary[key] for key in ("items", "failed")}


ARMS: Mapping[str, Callable[[int], Mapping[str, float]]] = {"nemo_town": nemo_town}
BENCHMARK = Benchmark(
    question="Do heads on a world model of towns learn to find, follow and forecast real road users?",
    arms=ARMS,
    seeds=(0,),
    config={"train_s": TRAIN_S, "judge_s": JUDGE_S, "stride_s": STRIDE_S, "steps": STEPS},
    decided_by=("foredrive.methods", "foredrive.engine", "foredrive.tasks", "foredrive.data"),
)
