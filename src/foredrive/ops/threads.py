"""Parallel kernels on Python threads, with torch's number of threads. The kernels release the GIL.

Compared with numba's `prange`, this compiles in a third of the time, can be called from several threads at
once, and survives a fork of the process.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

import torch

T = TypeVar("T")

RANGES_PER_THREAD = 4
"""Number of ranges per thread. More than one balances the load when some cores are busy."""


def in_parallel(job: Callable[[int, int], None], count: int, grain: int = 1) -> None:
    """Call job(start, stop) on ranges that cover range(count), with at least `grain` elements each.

    The last range may be shorter.
    """
    threads = torch.get_num_threads()
    # Several ranges per thread, but none shorter than the grain
    step = max(grain, -(-count // (RANGES_PER_THREAD * threads)))
    starts = range(0, count, step)
    if threads == 1 or len(starts) <= 1:
        if count:
            job(0, count)
        return
    # The result of each future raises what the job raised
    for done in [_pool(threads).submit(job, start, min(start + step, count)) for start in starts]:
        done.result()


def prefetched(items: Iterator[T]) -> Iterator[T]:
    """Yield the items; another thread prepares the next item meanwhile. With one torch thread it does not."""
    if torch.get_num_threads() == 1:
        yield from items
        return
    end = object()
    with ThreadPoolExecutor(1, thread_name_prefix="foredrive-ahead") as worker:
        # One item ahead: it is requested before the current one is used
        coming = worker.submit(next, items, end)
        while (item := coming.result()) is not end:
            coming = worker.submit(next, items, end)
            yield item  # type: ignore[misc]  # not the end


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="foredrive-ops")


os.register_at_fork(after_in_child=_pool.cache_clear)
