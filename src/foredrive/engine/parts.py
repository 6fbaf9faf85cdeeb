"""Steps in parts: gradients are accumulated over the parts, and several processes share them.

Random numbers, batch normalisation and losses belong to a part. A step is the mean over its parts, weighted
by their items. So, apart from rounding, a step does not depend on the processes that compute its parts.
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Part:
    """A part of a step."""

    number: int
    weight: float
    """Share of the items of the step."""
    items: list[int]


def parts_of_step(batch: Sequence[int], count: int) -> list[Part]:
    """Return `count` parts of a batch. Items of a batch that is too short are repeated."""
    # The last batch of an epoch may have fewer items than there are parts, and no part may be empty
    padded = list(itertools.islice(itertools.cycle(batch), max(len(batch), count)))
    taken = [padded[number::count] for number in range(count)]
    return [Part(number, len(items) / len(padded), items) for number, items in enumerate(taken)]


def mean_losses(parts: Iterable[tuple[float, dict[str, float]]]) -> dict[str, float]:
    """Return the weighted means of the losses of parts, by name; a part may lack some."""
    sums: dict[str, tuple[float, float]] = {}
    for weight, losses in parts:
        for name, value in losses.items():
            total, weights = sums.get(name, (0.0, 0.0))
            sums[name] = (total + weight * value, weights + weight)
    return {name: total / weights for name, (total, weights) in sums.items()}


class StepBuffers:
    """The buffers of a module that training changes: running statistics, counters.

    Every part of a step starts from the buffers at the beginning of the step. At its end, they are the mean
    of those after each part; whole numbers are the same after each part.

    Args:
        module: the trained module.
    """

    def __init__(self, module: nn.Module) -> None:
        parameters = {id(parameter) for parameter in module.parameters()}
        # Only the persistent buffers, which a checkpoint holds
        state = module.state_dict(keep_vars=True).values()
        self._buffers = [value for value in state if id(value) not in parameters]
        self._means = [buffer for buffer in self._buffers if buffer.is_floating_point()]

    def begin(self) -> None:
        """Begin a step."""
        self._before = [buffer.clone() for buffer in self._buffers]
        self._sums = [torch.zeros_like(buffer) for buffer in self._means]

    @torch.no_grad()
    def end_part(self, weight: float, *, last: bool) -> None:
        """End a part of this process; unless it is its last, go back to the beginning of the step."""
        for total, buffer in zip(self._sums, self._means, strict=True):
            total.add_(buffer, alpha=weight)
        if not last:
            for buffer, before in zip(self._buffers, self._before, strict=True):
                buffer.copy_(before)

    @torch.no_grad()
    def end(self, *, processes: int) -> None:
        """End the step: average over the parts of all processes."""
        if not self._means:
            return
        # One exchange for all buffers. The weights of all parts add up to 1, so the sum is the mean
        joined = torch.cat([total.flatten() for total in self._sums])
        if processes > 1:
            torch.distributed.all_reduce(joined)
        sizes = [buffer.numel() for buffer in self._means]
        for buffer, mean in zip(self._means, joined.split(sizes), strict=True):
            buffer.copy_(mean.view_as(buffer))


def whole(tensor: Tensor) -> Tensor:
    """Return a tensor that processes hold in shards (FSDP) as one tensor. Every process has to call it."""
    gather = getattr(tensor, "full_tensor", None)
    return tensor if gather is None else gather()


def placed_like(tensor: Tensor, other: Tensor) -> Tensor:
    """Return a tensor in the same shards as another one of its shape; itself if the other is whole."""
    if not hasattr(other, "full_tensor"):
        return tensor
    from torch.distributed.tensor import DTensor, distribute_tensor  # Slow to import

    assert isinstance(other, DTensor)
    return distribute_tensor(tensor.to(other.device), other.device_mesh, other.placements)
