"""Work on threads."""

import threading
from collections.abc import Iterator

import pytest
import torch

from foredrive.ops.threads import prefetched


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_items_come_in_order_and_no_more_than_one_ahead(threads: int) -> None:
    made, makers = [], set()

    def items() -> Iterator[int]:
        for i in range(5):
            makers.add(threading.get_ident())
            made.append(i)
            yield i

    for i, item in enumerate(prefetched(items())):
        assert item == i
        assert len(made) <= i + threads
    assert made == list(range(5))
    assert (threading.get_ident() in makers) == (threads == 1)


def test_a_failure_arrives_after_what_was_made_before_it(threads: int) -> None:
    def items() -> Iterator[int]:
        yield 0
        raise OSError("the disk is full")

    ahead = prefetched(items())
    assert next(ahead) == 0
    with pytest.raises(OSError, match="full"):
        next(ahead)


def test_whoever_stops_early_leaves_no_thread(threads: int) -> None:
    for item in (ahead := prefetched(iter(range(100)))):
        if item == 2:
            break
    ahead.close()
    assert not any(t.name.startswith("foredrive-ahead") for t in threading.enumerate())
