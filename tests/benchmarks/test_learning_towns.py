"""The drives that `learning` trains and tests on."""

import pytest

from benchmarks.learning_towns import TEST_SEEDS, TEST_TOWNS, TRAIN_SEEDS, TRAIN_TOWNS, plan_learning


@pytest.mark.slow
def test_drives_are_those_of_the_digest() -> None:
    plans = plan_learning()
    assert len(plans) == len(TEST_TOWNS) * len(TEST_SEEDS) + len(TRAIN_TOWNS) * len(TRAIN_SEEDS)
    assert {plan.town for plan in plans[: len(TEST_SEEDS)]} == set(TEST_TOWNS)
