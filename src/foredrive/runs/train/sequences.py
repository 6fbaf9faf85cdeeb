"""Sequences of key frames, for the training of heads that carry agents on."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from torch.utils.data import Dataset

from foredrive.engine.loop import Schedule
from foredrive.errors import InputError
from foredrive.heads.heads import TaskHeadsConfig
from foredrive.tasks.files.frame_keys import log_of, time_of

T = TypeVar("T")
TOLERANCE = 0.25
"""Maximum deviation of the time between frames, as a share of it."""


class FrameSequences(Dataset[list[T]]):
    """All sequences of items of one log whose nows are a fixed time apart.

    Args:
        items: a data set.
        keys: name of each item, LOG@T_US, in the order of log and time.
        frames: items of a sequence.
        dt_s: time between them.

    Raises:
        InputError: no log is long enough.
    """

    def __init__(self, items: Dataset[T], keys: Sequence[str], frames: int, dt_s: float) -> None:
        self.items = items
        after = _successors(keys, dt_s)
        self.sequences = [
            sequence for first in range(len(keys)) if (sequence := _sequence(first, after, frames))
        ]
        if not self.sequences:
            raise InputError(f"no log has {frames} clips that are {dt_s:g} s apart")

    def __len__(self) -> int:
        return len(self.sequences)

    def __getitem__(self, index: int) -> list[T]:
        """Return the items of one sequence, in the order of time."""
        return [self.items[number] for number in self.sequences[index]]


def collate_sequences(collate: Callable[[list[T]], T]) -> Callable[[list[list[T]]], T]:
    """Return a function that collates sequences to one batch: the items of the first sequence come first."""

    def joined(sequences: list[list[T]]) -> T:
        return collate([item for sequence in sequences for item in sequence])

    return joined


def in_sequences(
    items: Dataset[T],
    keys: Sequence[str],
    collate: Callable[[list[T]], T],
    heads: TaskHeadsConfig,
    schedule: Schedule,
) -> tuple[Dataset[Any], Callable[[list[Any]], T], Schedule]:
    """Return items, collation and schedule of a training of heads.

    Heads that carry agents on get sequences, and fewer of them in a batch, so that a step costs the same.

    Args:
        items: a data set.
        keys: name of each item.
        collate: joins items to a batch.
        heads: sizes of the heads.
        schedule: for single items.

    Raises:
        InputError: no log is long enough for a sequence.
    """
    if heads.agents is None or heads.agents.carried is None:
        return items, collate, schedule
    config = heads.agents.carried
    batch_size = max(1, schedule.batch_size // config.frames)
    sequences = FrameSequences(items, keys, config.frames, config.dt_s)
    return sequences, collate_sequences(collate), replace(schedule, batch_size=batch_size)


def _successors(keys: Sequence[str], dt_s: float) -> dict[int, int]:
    """Return the item that follows each item after about `dt_s`, where there is one."""
    successors: dict[int, int] = {}
    for _, group in itertools.groupby(range(len(keys)), lambda number: log_of(keys[number])):
        numbers = list(group)
        t_s = np.array([1e-6 * time_of(keys[number]) for number in numbers])
        off_s = np.abs(t_s[None] - t_s[:, None] - dt_s)
        nearest = off_s.argmin(axis=1)
        for row, column in enumerate(nearest.tolist()):
            if off_s[row, column] <= TOLERANCE * dt_s:
                successors[numbers[row]] = numbers[column]
    return successors


def _sequence(first: int, after: dict[int, int], frames: int) -> list[int]:
    """Return a sequence from its first item on; an empty one if the log ends before."""
    indices = [first]
    while len(indices) < frames:
        if indices[-1] not in after:
            return []
        indices.append(after[indices[-1]])
    return indices
