"""Full precision for geometry within autocast."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


@contextmanager
def full_precision(*tensors: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Disable autocast, and yield the tensors in float32, or in float64 if any of them is float64.

    Half precision would move points by pixels and turn rays by tenths of a degree, and neither geometry nor
    sampling is faster in it.
    """
    dtype = torch.float64 if any(t.dtype == torch.float64 for t in tensors) else torch.float32
    with torch.autocast(tensors[0].device.type, enabled=False):
        yield tuple(t.to(dtype) for t in tensors)
