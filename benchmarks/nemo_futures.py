"""Limits of NeMo's futures: `foredrive bench nemo-futures`.

The shipped NeMo forecasts the exact occupancy of virtual egos in towns, those of planner_reads. What moves is
judged apart from what stands. Beside its futures stand its present, left where it is, moved along the driven
path or on as measured, and the true present, moved along with the true flow and the driven path.
"""

import dataclasses

import torch
from torch.utils.data import DataLoader

from benchmarks.common.benchmark import Benchmark
from benchmarks.planner_reads import ROOT, SHIPPED, logs_to_judge
from foredrive.data import ClipDataset, collate
from foredrive.engine.summary import Figures, numbers
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.run import load_agent, open_run
from foredrive.scene import Example
from foredrive.scene.voxels import MOVING_MPS
from foredrive.tasks.evaluation.run import evaluate
from foredrive.tasks.metric import EvaluationContext, Shown, labels_from_now
from foredrive.tasks.occupancy.flow_metric import FlowMetric
from foredrive.tasks.occupancy.occupancy_metric import OccupancyMetric
from foredrive.tasks.occupancy.scores import above_ground
from foredrive.tasks.predictor import Part, Prediction

LOGS_APART, STRIDE_S = 2, 1.0
"""Every second ego is judged, at nows so far apart."""
KEPT = ("occupancy.moving.iou_", "occupancy.standing.iou_", "occupancy.above_ground.iou_", "flow.", "share.")


class MovingShareMetric:
    """Key: `moving_pct`, the share of the occupied voxels above the ground that move."""

    name = "share"
    title = "Moving voxels"
    shown: tuple[Shown, ...] = ()
    needs: frozenset[Part] = frozenset({"occupancy_logit"})

    def __init__(self, context: EvaluationContext) -> None:
        self._moving = self._occupied = 0

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Count the voxels of b clips at now."""
        labels, flow = (labels_from_now(grid, truth.clip, 1) for grid in (truth.occupancy, truth.flow))
        occupied = (labels.values[:, :, 0] > 0.5) & labels.known & above_ground(labels.spec)
        self._occupied += int(occupied.sum())
        self._moving += int((occupied & flow.known & (flow.values.norm(dim=2) > MOVING_MPS)).sum())

    def result(self) -> Figures:
        """Return the ratio of the sums."""
        return {"moving_pct": 100 * self._moving / max(self._occupied, 1)}


def shipped(_: int) -> dict[str, float]:
    """Evaluate the shipped model."""
    torch.set_num_threads(1)
    run = open_run(run_folder(SHIPPED, ROOT / "models"))
    clips = dataclasses.replace(
        run.recipe.clips, occupancy_source="recorded", future_images=False, now_stride_s=STRIDE_S
    )
    result = evaluate(
        AgentPredictor(load_agent(run), clips.future_frames, ray_stride=0),
        DataLoader(ClipDataset(logs_to_judge()[::LOGS_APART], clips, None), batch_size=4, collate_fn=collate),
        frame_dt_s=clips.frame_dt_s,
        metrics=(OccupancyMetric, FlowMetric, MovingShareMetric),
    )
    figures = numbers(result.summary)
    return {key: value for key, value in figures.items() if key.startswith((*KEPT, "items", "failed"))}


BENCHMARK = Benchmark(
    question="What limits the futures of a world model?",
    arms={"nemo_town": shipped},
    seeds=(0,),
    config={"logs_apart": LOGS_APART, "stride_s": STRIDE_S},
)
