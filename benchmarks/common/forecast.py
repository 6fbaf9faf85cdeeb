"""Forecasts of occupancy: the predictions of a run for parts of logs; plans are not evaluated."""

from collections.abc import Sequence
from dataclasses import replace

from torch.utils.data import DataLoader

from foredrive.data import LogPath, collate
from foredrive.engine.summary import numbers
from foredrive.methods.recipe import Recipe
from foredrive.runs.evaluate.inputs import FUTURES
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.open_clips import open_clips
from foredrive.runs.train.baselines import run_baselines
from foredrive.runs.train.run import Run, load_agent
from foredrive.tasks.evaluation.run import evaluate

BATCH = 4


def forecasting(
    recipe: Recipe, part_s: tuple[float, float], stride_s: float, future_frames: int | None = None
) -> Recipe:
    """Return a recipe that trains only the world model, with the losses of pre-training, on parts of logs.

    Args:
        part_s: see `ClipConfig`.
        stride_s: time between the clips' nows, s.
        future_frames: number of imagined and evaluated frames; None: as in the recipe.
    """
    assert recipe.pretrain is not None
    stage = replace(recipe.pretrain, schedule=recipe.finetune.schedule)
    planner = replace(recipe.planner, ego_mlp=None, path=None)
    clips = replace(
        recipe.clips,
        part_s=part_s,
        now_stride_s=stride_s,
        future_frames=recipe.clips.future_frames if future_frames is None else future_frames,
    )
    return replace(recipe, clips=clips, planner=planner, pretrain=None, finetune=stage, path=None)


def judge_forecast(
    run: Run, logs: Sequence[LogPath], part_s: tuple[float, float], stride_s: float | None = None
) -> dict[str, float]:
    """Evaluate occupancy and flow, now and later, beside persistence.

    Args:
        part_s: the judged part of the logs.
        stride_s: time between the clips' nows, s; None: as in the recipe.

    Raises:
        InputError: there is nothing to evaluate.
    """
    clips = run.recipe.clips
    judged = replace(
        clips,
        part_s=part_s,
        now_stride_s=stride_s or clips.now_stride_s,
        future_images=False,
    )
    dataset = open_clips(logs, judged, run.cache_dir)
    prior, _ = run_baselines(run.folder, run.logs, run.recipe, run.cache_dir, clips.past_frames)
    result = evaluate(
        AgentPredictor(load_agent(run), clips.future_frames, 0, FUTURES),
        DataLoader(dataset, batch_size=BATCH, collate_fn=collate),
        frame_dt_s=clips.frame_dt_s,
        prior=prior,
    )
    summary = numbers(result.summary)
    kept = ("occupancy.iou_", "occupancy.above_ground.iou_", "occupancy.above_ground.spread_", "flow.")
    figures = {key: value for key, value in summary.items() if key.startswith(kept)}
    return figures | {key: summary[key] for key in ("items", "failed")}
