"""Baselines of a trained model, fitted to the logs that the model was trained on."""

import dataclasses
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from torch import nn
from torch.utils.data import DataLoader

from foredrive.data import ClipDataset, LogPath, collate
from foredrive.engine.checkpoints import load_weights
from foredrive.methods.planner.ego_mlp import EgoMLP, EgoMLPConfig
from foredrive.methods.planner.ego_mlp_fit import StatusDemonstrations, fit_ego_mlp, read_status
from foredrive.methods.recipe import Recipe
from foredrive.scene import Clip, Example
from foredrive.tasks.metric import labels_from_now
from foredrive.tasks.occupancy.scores import OccupancyPrior


@lru_cache(maxsize=1)  # training, evaluation and the next arm of a study use the same baselines
def fit_baselines(
    logs: tuple[LogPath, ...], recipe: Recipe[Any, Any], cache_dir: Path, past_frames: int
) -> tuple[OccupancyPrior, EgoMLP]:
    """Return the occupancy prior of the labels and an ego MLP; reads all clips, without images.

    Args:
        logs: logs of the training set.
        recipe: recipe of the model.
        cache_dir: folder of the cached labels.
        past_frames: number of past frames in the ego status.

    Raises:
        InputError: a log cannot be read.
    """
    clips, target = dataclasses.replace(recipe.clips.judged, tasks=None), recipe.planner.target
    dataset = ClipDataset(logs, clips, cache_dir, images=False)
    loader = DataLoader(dataset, batch_size=16, collate_fn=collate)
    sizes = recipe.planner.ego_mlp or EgoMLPConfig()
    read = {"target": target, "rates": sizes.rates}
    prior, status = read_training_set(loader, clips.future_frames + 1, past_frames, **read)
    mlp = fit_ego_mlp(
        sizes, status, recipe.ego_mlp, past_frames=past_frames, dt_s=clips.horizon_dt_s, target=target
    )
    return prior, mlp


def run_baselines(
    folder: Path, logs: tuple[LogPath, ...], recipe: Recipe[Any, Any], cache_dir: Path, past_frames: int
) -> tuple[OccupancyPrior, EgoMLP]:
    """Return the baselines of a run: those in its folder, or fitted ones.

    Models that come with the package have them in their folder, because they come without training logs.

    Args:
        folder: folder of the run.
        logs, recipe, cache_dir, past_frames: as for `fit_baselines`.

    Raises:
        InputError: a log cannot be read, or the file is of other sizes.
    """
    clips = recipe.clips.judged
    file = folder / baselines_file(past_frames)
    if file.is_file():
        prior = OccupancyPrior(clips.future_frames + 1, clips.voxels)
        mlp = EgoMLP(
            recipe.planner.ego_mlp or EgoMLPConfig(),
            past_frames=past_frames,
            horizon_steps=clips.horizon_steps,
            dt_s=clips.horizon_dt_s,
            target=recipe.planner.target,
        )
        load_weights(Baselines(prior, mlp), file)
        return prior, mlp.eval()
    return fit_baselines(logs, recipe, cache_dir, past_frames)


def baselines_file(past_frames: int) -> str:
    """Return the name of the file of a run that keeps its baselines."""
    return f"baselines_of_{past_frames}_past_frames.safetensors"


class Baselines(nn.Module):
    """The baselines as one module, to be saved and loaded like weights."""

    def __init__(self, prior: OccupancyPrior, mlp: EgoMLP) -> None:
        super().__init__()
        self.register_buffer("occupied", prior.occupied)
        self.register_buffer("known", prior.known)
        self.mlp = mlp


def read_training_set(
    loader: Iterable[Example], frames: int, past_frames: int, *, target: bool = False, rates: bool = False
) -> tuple[OccupancyPrior, StatusDemonstrations]:
    """Read the training data of the baselines in one pass; images are not used.

    Args:
        loader: yields batches.
        frames: number of key frames in the occupancy prior: now and the future ones.
        past_frames: number of past frames in the ego status.
        target: whether the ego status contains the route target.
        rates: whether it contains the rates of motion.

    Raises:
        InputError: there are no batches.
    """
    prior: OccupancyPrior | None = None

    def clips() -> Iterator[Clip]:
        nonlocal prior
        for example in loader:
            labels = labels_from_now(example.occupancy, example.clip, frames)
            prior = prior or OccupancyPrior(frames, labels.spec)
            prior.add(labels)
            yield example.clip

    status = read_status(clips(), past_frames, target=target, rates=rates)
    assert prior is not None
    return prior, status
