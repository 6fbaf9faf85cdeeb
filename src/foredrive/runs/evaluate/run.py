"""Evaluate a run on logs: the model and its baselines, in one summary."""

import contextlib
import dataclasses
import functools
import itertools
import pickle
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from rich.progress import Progress
from torch import Tensor

from foredrive.data import ClipDataset, LogPath, collate
from foredrive.engine.fan_out import fan_out, reason
from foredrive.engine.provenance import collect_provenance
from foredrive.engine.summary import write_summary
from foredrive.errors import InputError
from foredrive.methods.planner.baselines import ConstantVelocity, StandStill
from foredrive.runs.evaluate.inputs import (
    RENDER_STRIDE,
    Batches,
    EvaluationInputs,
    EvaluationSource,
    agent_predictor,
    open_inputs,
    plan_batches,
)
from foredrive.runs.open_clips import open_clips
from foredrive.runs.train.baselines import run_baselines
from foredrive.runs.train.run import Run, load_agent, open_run
from foredrive.runs.train.tasks import load_heads
from foredrive.scene import Example, Trajectory
from foredrive.tasks.evaluation.results_files import ResultsFiles
from foredrive.tasks.evaluation.run import (
    EvaluationResult,
    Failure,
    PredictedBatch,
    judge,
    parts_needed,
    predict_batches,
)
from foredrive.tasks.metric import Figures
from foredrive.tasks.predictor import Part, Prediction

SHARD_BATCHES = 4
"""Batches of a shard. The limit keeps the memory independent of the length of a log."""


@dataclass(frozen=True)
class Shard:
    """Consecutive batches that one worker predicts."""

    number: int
    batches: tuple[tuple[int, ...], ...]


def predict_shards(
    inputs: EvaluationInputs,
    planned: Sequence[tuple[int, ...]],
    asked: frozenset[Part],
    workers: int,
    *,
    on_ray: bool = False,
) -> Generator[PredictedBatch, None, None]:
    """Yield the predicted batches in order.

    A shard whose process dies twice counts as failed, clip by clip.

    Args:
        planned: the clips of each batch.
        workers: as in `fan_out`.
    """
    dataset = inputs.dataset
    shards = plan_shards(dataset, planned, inputs.predictor.carries)
    threads = max(1, torch.get_num_threads() // workers)
    work = functools.partial(predict_shard, source=inputs.source, asked=asked, threads=threads)
    waiting, following = dict[int, list[PredictedBatch]](), 0
    with contextlib.closing(fan_out(shards, work, workers, on_ray=on_ray, on_gpu=True)) as results:
        for shard, result in results:
            if isinstance(result, BaseException):
                why = reason(f"shard {shard.number}", result)
                keys = [dataset.key(clip) for clip in itertools.chain(*shard.batches)]
                waiting[shard.number] = [PredictedBatch(None, (), tuple(Failure(key, why) for key in keys))]
            else:
                waiting[shard.number] = pickle.loads(result)
            while following in waiting:
                yield from waiting.pop(following)
                following += 1


def plan_shards(dataset: ClipDataset, planned: Sequence[tuple[int, ...]], whole_logs: bool) -> list[Shard]:
    """Return shards of a few batches each.

    Args:
        planned: the clips of each batch.
        whole_logs: whether a log is one shard, because a predictor carries something from frame to frame.
    """
    shards = []
    for _, of_log in itertools.groupby(planned, lambda clips: dataset.log_path(clips[0])):
        batches = tuple(of_log)
        size = len(batches) if whole_logs else SHARD_BATCHES
        shards += [batches[first : first + size] for first in range(0, len(batches), size)]
    return [Shard(number, batches) for number, batches in enumerate(shards)]


def predict_shard(shard: Shard, source: EvaluationSource, asked: frozenset[Part], threads: int) -> bytes:
    """Return the predicted batches of a shard, pickled.

    Processes would hand over each tensor by a file descriptor of its own, and run out of them.
    """
    torch.set_num_threads(threads)
    inputs = _opened(source)
    predicted = predict_batches(
        inputs.predictor, Batches(inputs.dataset, shard.batches), asked, inputs.device
    )
    return pickle.dumps([batch.to("cpu") for batch in predicted])


@functools.lru_cache(maxsize=1)
def _opened(source: EvaluationSource) -> EvaluationInputs:
    """Open the inputs, and keep them for the next shard."""
    return open_inputs(open_run(source.run), source)


SUMMARY, RESULTS = "summary.json", "results"


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


def evaluate_run(
    run: Run,
    logs: Sequence[LogPath],
    out: Path,
    batch_size: int = 4,
    *,
    views: bool = True,
    stride_s: float | None = None,
    results_files: bool = False,
    workers: int = 1,
    on_ray: bool = False,
) -> EvaluationResult:
    """Evaluate a trained run on logs and write `out/summary.json`. Clips that cannot be read count as failed.

    The figures do not depend on the number of workers.

    Args:
        views: whether to render the camera views and evaluate them too; this takes a quarter of the time.
        stride_s: time between the clips' nows, s; None: as in the recipe.
        results_files: whether to write what the task heads predict to `out/results`, in public formats.
        workers: processes that predict; 1 predicts in this process. Metrics and baselines are computed here.
        on_ray: whether the workers are those of a Ray cluster; see `fan_out`.

    Raises:
        InputError: the run has not finished a stage, or no clip can be read.
    """
    if batch_size < 1:
        raise InputError(f"the batch size must be at least 1, got {batch_size}")
    source = EvaluationSource(run.folder.absolute(), tuple(log.absolute() for log in logs), stride_s, views)
    inputs = open_inputs(run, source)
    dataset, trained, clips = inputs.dataset, inputs.heads, run.recipe.clips
    if results_files and trained is None:
        raise InputError(f"{run.folder}: has no task heads whose results could be written")
    prior, ego_mlp = run_baselines(run.folder, run.logs, run.recipe, run.cache_dir, clips.past_frames)
    steps, dt_s = clips.horizon_steps, clips.horizon_dt_s
    planned, asked = plan_batches(dataset, batch_size), parts_needed()
    if workers > 1 or on_ray:
        device, batches = "cpu", predict_shards(inputs, planned, asked, workers, on_ray=on_ray)
    else:
        device = inputs.device
        batches = predict_batches(inputs.predictor, Batches(dataset, planned), asked, device)
    writing = ResultsFiles.written_to(out / RESULTS) if results_files else contextlib.nullcontext()
    with writing as files, Progress() as progress, contextlib.closing(batches):
        task = progress.add_task("evaluate", total=len(dataset))
        result = judge(
            batches,
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
            on_prediction=(lambda prediction, truth: None) if files is None else files.add,
        )
    origin = {"recipe": run.recipe.name, "run": str(run.folder)}
    figures = result.summary | _clip_figures(dataset)
    write_summary(out / SUMMARY, figures | collect_provenance() | run.conditions | origin)
    return dataclasses.replace(result, summary=figures)


def _clip_figures(dataset: ClipDataset) -> Figures:
    """Return what a clip has to have around its now, and how many times of the logs have not."""
    config = dataset.config
    return {
        "clips.stride_s": config.now_stride_s,
        "clips.past_s": config.past_frames * config.frame_dt_s,
        "clips.future_s": config.future_frames * config.frame_dt_s,
        **{f"clips.left_out.{reason}": count for reason, count in dataset.left_out.items()},
    }


@torch.no_grad()
def predict_examples(run: Run, logs: Sequence[LogPath], count: int) -> list[ExamplePrediction]:
    """Predict `count` examples spread evenly over the logs; leave out those that cannot be read."""
    agent, trained = load_agent(run), load_heads(run)
    clips = run.recipe.clips
    tasks = clips.tasks if trained is None else trained.recipe.truth
    config = dataclasses.replace(clips.judged, lidar=True, map=True, tasks=tasks)
    dataset = open_clips(logs, config, run.cache_dir)
    predictor = agent_predictor(agent, trained, clips.future_frames, RENDER_STRIDE)
    predictions = []
    for k in range(min(count, len(dataset))):
        try:
            item = dataset[int((k + 0.5) * len(dataset) / count)]
        except InputError:
            continue
        observed = collate([item]).clip.observed()
        prediction = predictor.predict(observed, frozenset({"occupancy_logit", "plan", "images"}))
        assert prediction.occupancy_logit is not None
        assert prediction.plan is not None
        predictions.append(
            ExamplePrediction(
                example=item,
                occupied=prediction.occupancy_logit[0] > 0,
                rendered=None if prediction.images is None else prediction.images[0, 0],
                volume=agent.world_model.observe(observed).volume[0],
                plan=prediction.plan[0],
                tasks=None if trained is None else prediction,
            )
        )
    return predictions
