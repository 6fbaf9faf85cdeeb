"""Sharing the work of a kernel among threads."""

import multiprocessing
import threading

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from foredrive.ops.threads import in_parallel
from foredrive.ops.volume import sample_volume


@given(count=st.integers(0, 500), grain=st.integers(1, 200))
def test_ranges_cover_everything_once(count: int, grain: int) -> None:
    ranges: list[tuple[int, int]] = []
    in_parallel(lambda start, stop: ranges.append((start, stop)), count, grain)
    ranges.sort()
    assert [i for start, stop in ranges for i in range(start, stop)] == list(range(count))
    assert all(stop - start >= grain for start, stop in ranges[:-1])


def test_as_many_threads_as_torch_uses() -> None:
    used: set[str] = set()
    meet = threading.Barrier(3, timeout=20)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        in_parallel(lambda *_: (used.add(threading.current_thread().name), meet.wait()), 3)
        assert len(used) == 3
        torch.set_num_threads(1)
        used.clear()
        in_parallel(lambda *_: used.add(threading.current_thread().name), 100)
        assert used == {threading.current_thread().name}
    finally:
        torch.set_num_threads(threads)


def test_errors_come_through() -> None:
    def job(start: int, stop: int) -> None:
        raise ZeroDivisionError(start)

    with pytest.raises(ZeroDivisionError):
        in_parallel(job, 1000)


def read_something() -> None:
    volume, points = torch.ones(1, 2, 2, 2, 1), torch.ones(1, 2000, 3)
    assert torch.equal(sample_volume(volume, points), torch.ones(1, 2000, 1))


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_process_works_on() -> None:
    """Data loaders fork after the parent's threads have run."""
    read_something()
    child = multiprocessing.get_context("fork").Process(target=read_something)
    child.start()
    child.join(60)
    alive = child.is_alive()
    child.kill()
    assert not alive
    assert child.exitcode == 0
