"""Gates before any long training: a planner uses what its volume holds."""

import pytest

from benchmarks.planner_reads import cell_error_m


@pytest.mark.slow
def test_the_decoder_finds_a_lit_cell() -> None:
    """Places of 0.02, or dropout on the one query, learn no more than to name the mean."""
    assert cell_error_m(seed=0) < 0.1
