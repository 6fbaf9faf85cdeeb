"""Batches and shards of an evaluation hold the clips of one log, all of them once and in order."""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from small_drives import one_example

from foredrive.data import ClipDataset, LogPath
from foredrive.errors import InputError
from foredrive.runs.evaluate.inputs import Batches, plan_batches
from foredrive.runs.evaluate.run import SHARD_BATCHES, plan_shards


class Clips(ClipDataset):
    """Clips of logs of these lengths, named by their indices; those in `lost` cannot be read."""

    def __init__(self, *lengths: int, lost: tuple[int, ...] = ()) -> None:
        self._log_of = list(itertools.chain(*([number] * length for number, length in enumerate(lengths))))
        self._lost = lost

    def __len__(self) -> int:
        return len(self._log_of)

    def log_path(self, index: int) -> LogPath:
        return LogPath(Path(str(self._log_of[index])), Path())

    def __getitem__(self, index: Any) -> Any:
        if index in self._lost:
            raise InputError(f"clip {index}")
        return dataclasses.replace(one_example(index)[0], key=(str(index),))


def test_a_batch_holds_clips_of_one_log() -> None:
    assert plan_batches(Clips(3, 1, 4), 2) == [(0, 1), (2,), (3,), (4, 5), (6, 7)]


@pytest.mark.parametrize(("whole_logs", "sizes"), [(False, [SHARD_BATCHES, 1, 2]), (True, [5, 2])])
def test_a_shard_holds_batches_of_one_log(whole_logs: bool, sizes: list[int]) -> None:
    clips = Clips(10, 3)
    planned = plan_batches(clips, 2)
    shards = plan_shards(clips, planned, whole_logs)
    assert [len(shard.batches) for shard in shards] == sizes
    assert [shard.number for shard in shards] == list(range(len(shards)))
    assert list(itertools.chain(*(shard.batches for shard in shards))) == planned


def read_all(batches: Iterator[Any]) -> list[Any]:
    found: list[Any] = []
    while True:
        try:
            found.append(next(batches))
        except InputError as error:
            found.append(str(error))
        except StopIteration:
            return found


def test_a_lost_clip_leaves_the_others_in_their_batches() -> None:
    batches = Batches(Clips(5, lost=(1, 4)), [(0, 1), (2, 3), (4,)])
    found = [batch if isinstance(batch, str) else batch.key for batch in read_all(batches)]
    assert found == ["clip 1", ("0",), ("2", "3"), "clip 4"]
