"""Baselines of map and semantic occupancy: the one prediction that fits the training set best."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from foredrive.scene.record import Record
from foredrive.scene.semantics import VOXEL_CLASSES
from foredrive.scene.task_truth import TaskTruth


@dataclass(frozen=True)
class TaskPriors(Record):
    """Constant predictions. None without truth in the training set."""

    layers: Bool[Tensor, "L H W"] | None = None
    """A mask of each `RasterLayer`."""
    semantics: UInt8[Tensor, "Z Y X"] | None = None
    """The commonest class of each voxel."""


def fit_task_priors(truths: Iterable[TaskTruth]) -> TaskPriors:
    """Return the priors of unbatched truths."""
    drawn: Tensor | None = None
    votes: Tensor | None = None
    maps = 0
    for truth in truths:
        if truth.raster is not None and bool(truth.raster.known):
            # Sum of the masks over frames with a map: the frequency of each cell after division
            layers = truth.raster.layers.double()
            drawn, maps = layers if drawn is None else drawn + layers, maps + 1
        if truth.semantics is not None:
            classes = len(VOXEL_CLASSES[truth.semantics.taxonomy])
            index = truth.semantics.index.long()[None]
            vote = torch.zeros(classes, *index.shape[1:], dtype=torch.int32)
            # One vote of each frame for the class of every known voxel
            vote.scatter_(0, index, truth.semantics.known[None].int())
            votes = vote if votes is None else votes + vote
    return TaskPriors(
        None if drawn is None else torch.stack([best_mask(layer / maps) for layer in drawn]),
        None if votes is None else votes.argmax(dim=0).to(torch.uint8),
    )


def best_mask(frequency: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Return the constant mask with the best IoU over all frames, given how often each cell is covered.

    It takes the most frequent cells. With frequencies p, IoU is Σp / (cells + Σp of the others).
    """
    # Take cells in order of frequency; the best number of them has the largest IoU
    ordered = frequency.flatten().sort(descending=True).values
    hits = ordered.cumsum(0)
    cells = torch.arange(1, len(ordered) + 1)
    # Expected hits over the union: chosen cells, plus what is covered elsewhere
    best = (hits / (cells + hits[-1] - hits)).argmax()
    return (frequency >= ordered[best]) & (frequency > 0)
