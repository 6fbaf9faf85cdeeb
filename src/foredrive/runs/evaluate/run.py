"""Evaluate a run on logs: the model and its baselines, in one summary."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from rich.progress import Progress
from torch import Tensor

from foredrive.data import ClipDataset, LogPath, collate
from foredrive.data.task_truth import TaskTruthConfig
from foredrive.errors import InputError
from foredrive.evaluation.baselines import ConstantVelocity, StandStill
from foredrive.evaluation.predictor import Prediction
from foredrive.evaluation.provenance import collect_provenance
from foredrive.evaluation.results_files import ResultsFiles
from foredrive.evaluation.run import EvaluationResult, evaluate
from foredrive.evaluation.summary import write_summary
from foredrive.metrics.protocols import STEP_S, STEPS
from foredrive.models.agent import PlanningAgent
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.open_clips import open_clips
from foredrive.runs.train.baselines import run_baselines
from foredrive.runs.train.run import Run, load_agent
from foredrive.runs.train.tasks import TrainedHeads, load_heads
from foredrive.scene import Example, Trajectory

SUMMARY, RESULTS = "summary.json", "results"
RENDER_STRIDE = 2
"""One pixel in this many along rows and columns is rendered and compared."""
FUTURES = 5
"""Number of futures drawn from a stochastic world model."""


@dataclass(frozen=True)
class ExamplePrediction:
    """One unbatched example and the model's predictions, for pictures."""

    example: Example
    occupied: Bool[Tensor, "F Z Y X"]
    """Voxels predicted occupied at now and at the F - 1 key frames after it, each in its own ego frame."""
    rendered: Float[Tensor, "C 3 h w"] | None
    """The rendered views at now, RGB 0 to 1, of any size; None from a world model that does not render."""
    volume: Float[Tensor, "D Z Y X"]
    plan: Trajectory
    """The plan; batch shape [1 T]."""
    tasks: Prediction | None = None
    """What task heads predict, as a batch of one; None from a run without heads."""


def evaluation_data(
    run: Run,
    logs: Sequence[LogPath],
    stride_s: float | None = None,
    truth: TaskTruthConfig | None = None,
) -> ClipDataset:
    """Open the clips of `logs` as the recipe defines them, with the boxes for collisions up to 3 s.

    Args:
        stride_s: time between the clips' nows, s; None: as in the recipe.
        truth: truth of further tasks to read.
    """
    clips = run.recipe.clips
    frames = max(clips.future_frames, round(STEPS * STEP_S / clips.frame_dt_s))
    stride_s = stride_s or clips.now_stride_s
    tasks = truth or clips.tasks
    if tasks is not None and tasks.semantics is not None:
        tasks = dataclasses.replace(tasks, rays=True)
    config = dataclasses.replace(
        clips.judged,
        future_frames=frames,
        future_images=False,
        now_stride_s=stride_s,
        tasks=tasks,
    )
    return open_clips(logs, config, run.cache_dir)


class _Batches(Iterator[Example]):
    """Clips in batches. A clip that cannot be read raises an InputError; the next call continues after it."""

    def __init__(self, dataset: ClipDataset, batch_size: int) -> None:
        self._dataset, self._batch_size = dataset, batch_size
        self._left = iter(range(len(dataset)))
        self._read: list[Example] = []

    def __next__(self) -> Example:
        while len(self._read) < self._batch_size and (index := next(self._left, None)) is not None:
            self._read.append(self._dataset[index])
        if not self._read:
            raise StopIteration
        batch, self._read = collate(self._read), []
        return batch


def evaluate_run(
    run: Run,
    logs: Sequence[LogPath],
    out: Path,
    batch_size: int = 4,
    *,
    views: bool = True,
    stride_s: float | None = None,
    results_files: bool = False,
) -> EvaluationResult:
    """Evaluate a trained run on logs and write `out/summary.json`. Clips that cannot be read count as failed.

    Args:
        views: whether to render the camera views and evaluate them too; this takes a quarter of the time.
        stride_s: time between the clips' nows, s; None: as in the recipe.
        results_files: whether to write what the task heads predict to `out/results`, in public formats.

    Raises:
        InputError: the run has not finished a stage, or no clip can be read.
    """
    if batch_size < 1:
        raise InputError(f"the batch size must be at least 1, got {batch_size}")
    agent, trained = load_agent(run), load_heads(run)
    if results_files and trained is None:
        raise InputError(f"{run.folder}: has no task heads whose results could be written")
    files = ResultsFiles(out / RESULTS)
    clips = run.recipe.clips
    dataset = evaluation_data(run, logs, stride_s, None if trained is None else trained.recipe.truth)
    prior, ego_mlp = run_baselines(run.folder, run.logs, run.recipe, run.cache_dir, clips.past_frames)
    steps, dt_s = clips.horizon_steps, clips.horizon_dt_s
    device = "cuda" if torch.cuda.is_available() else "cpu"
    agent.to(device)
    with Progress() as progress:
        task = progress.add_task("evaluate", total=len(dataset))
        result = evaluate(
            _predictor(agent, trained, clips.future_frames, RENDER_STRIDE if views else 0, FUTURES),
            _Batches(dataset, batch_size),
            frame_dt_s=clips.frame_dt_s,
            baselines={
                "stand_still": StandStill(steps, dt_s),
                "constant_velocity": ConstantVelocity(steps, dt_s),
                "ego_mlp": ego_mlp.to(device),
            },
            prior=prior,
            task_priors=None if trained is None else trained.priors,
            command_source=dataset.command_source,
            device=device,
            on_items=lambda items: progress.advance(task, items),
            on_prediction=files.add if results_files else lambda prediction, truth: None,
        )
    if results_files:
        files.write()
    origin = {"recipe": run.recipe.name, "run": str(run.folder)}
    write_summary(out / SUMMARY, result.summary | collect_provenance() | run.conditions | origin)
    return result


def _predictor(
    agent: PlanningAgent[Any], trained: TrainedHeads | None, steps: int, ray_stride: int, futures: int = 0
) -> AgentPredictor:
    """Return a predictor with the agent's own heads, or else with those of a probe."""
    heads = agent.heads
    if heads is None and trained is not None:
        heads = trained.heads.to(agent.planner.plan.device)
    return AgentPredictor(agent, steps, ray_stride, futures, heads)


@torch.no_grad()
def predict_examples(run: Run, logs: Sequence[LogPath], count: int) -> list[ExamplePrediction]:
    """Predict `count` examples spread evenly over the logs; leave out those that cannot be read."""
    agent, trained = load_agent(run), load_heads(run)
    clips = run.recipe.clips
    tasks = clips.tasks if trained is None else trained.recipe.truth
    config = dataclasses.replace(clips.judged, lidar=True, map=True, tasks=tasks)
    dataset = open_clips(logs, config, run.cache_dir)
    predictor = _predictor(agent, trained, clips.future_frames, RENDER_STRIDE)
    found = []
    for k in range(min(count, len(dataset))):
        try:
            item = dataset[int((k + 0.5) * len(dataset) / count)]
        except InputError:
            continue
        observed = collate([item]).clip.observed()
        prediction = predictor.predict(observed, frozenset({"occupancy_logit", "plan", "images"}))
        assert prediction.occupancy_logit is not None
        assert prediction.plan is not None
        found.append(
            ExamplePrediction(
                example=item,
                occupied=prediction.occupancy_logit[0] > 0,
                rendered=None if prediction.images is None else prediction.images[0, 0],
                volume=agent.world_model.observe(observed).volume[0],
                plan=prediction.plan[0],
                tasks=None if trained is None else prediction,
            )
        )
    return found
