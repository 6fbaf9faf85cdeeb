"""Sequences of key frames from the names of clips."""

import pytest
from torch.utils.data import Dataset

from foredrive.errors import InputError
from foredrive.runs.train.sequences import FrameSequences, collate_sequences


class Numbers(Dataset[int]):
    def __getitem__(self, index: int) -> int:
        return index


def keys(**times_s: list[float]) -> list[str]:
    return [f"{log}@{round(1e6 * t)}" for log, times in times_s.items() for t in times]


def test_sequences_stay_within_a_log_and_skip_over_frames_between() -> None:
    """The first log has a clip each 0.25 s, the second a gap; the times of the third are not exact."""
    names = keys(a=[0.0, 0.25, 0.5, 0.75, 1.0], b=[0.0, 0.5, 1.5, 2.0], c=[0.0, 0.51, 1.0])
    found = FrameSequences(Numbers(), names, 3, 0.5)
    assert found.sequences == [[0, 2, 4], [9, 10, 11]]
    assert [found[n] for n in range(len(found))] == found.sequences
    assert FrameSequences(Numbers(), names, 2, 0.5).sequences == [
        [0, 2], [1, 3], [2, 4], [5, 6], [7, 8], [9, 10], [10, 11]
    ]  # fmt: skip


def test_a_batch_has_one_sequence_after_the_other() -> None:
    assert collate_sequences(sum)([[1, 2], [4]]) == 7
    assert collate_sequences(list)([[1, 2], [3, 4]]) == [1, 2, 3, 4]


def test_logs_that_are_too_short_are_one_line() -> None:
    with pytest.raises(InputError, match=r"no log has 3 clips that are 0\.5 s apart"):
        FrameSequences(Numbers(), keys(a=[0.0, 0.5], b=[0.0]), 3, 0.5)
