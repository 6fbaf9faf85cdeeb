"""Reading what baselines are fitted to."""

import pytest
import torch
from small_drives import drives

from foredrive.errors import InputError
from foredrive.runs.train.baselines import read_training_set


def test_the_prior_counts_the_frames_from_now_on() -> None:
    example = drives(0, 1, 2)
    prior, _ = read_training_set([example, drives(3)], frames=2, past_frames=1)
    now = example.clip.now
    expected = (
        example.occupancy.known[:, now : now + 2].sum(dim=0) + drives(3).occupancy.known[0, now : now + 2]
    )
    assert torch.equal(prior.known, expected.int())


def test_an_empty_training_set_is_named() -> None:
    with pytest.raises(InputError, match="empty"):
        read_training_set([], frames=1, past_frames=1)
