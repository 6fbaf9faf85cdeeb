"""The numba path of `attend_volume` as an autograd function."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from foredrive.ops.threads import in_parallel
from foredrive.ops.volume_kernels import ChannelSlice, VolumeGradients, VolumeInputs, read_back, read_queries

MIN_QUERIES = 256
"""Minimum number of queries per thread."""
CHANNELS_AT_ONCE = 16
"""Channels of a slice: one cache line. The backward pass runs in parallel over slices."""


def channel_slices(heads: int, channels: int) -> tuple[ChannelSlice, ...]:
    """Return the slices of the backward pass: each head's channels in slices of `CHANNELS_AT_ONCE`."""
    width = channels // heads
    parts = [
        (head, start, min(start + CHANNELS_AT_ONCE, (head + 1) * width))
        for head in range(heads)
        for start in range(head * width, (head + 1) * width, CHANNELS_AT_ONCE)
    ]
    return tuple(ChannelSlice(*part, slot) for slot, part in enumerate(parts))


class AttendVolume(torch.autograd.Function):
    """Weighted sums of trilinear samples, for float32 on the CPU. See `attend_volume`.

    The backward pass runs slice by slice. A head may have several slices, each with some of its channels.
    Each slice has its own slot for the gradients of the points. The slots of a head are summed at the end, so
    the result does not depend on the number of threads.
    """

    @staticmethod
    def forward(
        ctx: Any,
        values: Float[Tensor, "b Z Y X D"],
        points: Float[Tensor, "b Q H P 3"],
        weights: Float[Tensor, "b Q H P"],
        slices: tuple[ChannelSlice, ...],
    ) -> Float[Tensor, "b Q D"]:
        """Compute the sums. `slices` gives the channel slices of the backward pass."""
        values, points, weights = values.contiguous(), points.contiguous(), weights.contiguous()
        ctx.save_for_backward(values, points, weights)
        ctx.slices = slices
        inputs = VolumeInputs(*(tensor.detach().numpy() for tensor in (values, points, weights)))
        b, queries = weights.shape[:2]
        out = values.new_empty(b, queries, values.shape[-1])
        rows = out.numpy()

        def job(start: int, stop: int) -> None:
            # A range of the flat index (item, query) may cover parts of several items
            for item in range(start // queries, -(-stop // queries)):
                before = item * queries
                read_queries(inputs, item, max(start - before, 0), min(stop - before, queries), rows)

        in_parallel(job, b * queries, grain=MIN_QUERIES)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of values, points and weights, where they are wanted."""
        values, points, weights = ctx.saved_tensors
        wants_values, wants_points, wants_weights, _ = ctx.needs_input_grad
        slices: tuple[ChannelSlice, ...] = ctx.slices
        b, queries, heads, per_head = weights.shape
        grad_values = torch.zeros_like(values) if wants_values else values[:0]
        slots = len(slices)
        # One slot per slice: slices of one head do not add to the same numbers
        grad_points = points.new_empty(b, queries, slots if wants_points else 0, per_head, 3)
        grad_weights = weights.new_empty(b, queries, slots if wants_weights else 0, per_head)
        inputs = VolumeInputs(*(tensor.numpy() for tensor in (values, points, weights)))
        arguments = (grad_out.contiguous(), grad_values, grad_points, grad_weights)
        grads = VolumeGradients(*(tensor.numpy() for tensor in arguments))

        def job(start: int, stop: int) -> None:
            for item, index in (divmod(i, len(slices)) for i in range(start, stop)):
                read_back(inputs, item, slices[index], grads)

        in_parallel(job, b * len(slices))
        # Sum the slots of each head in fixed order
        if slots > heads:
            grad_points, grad_weights = (
                grad.unflatten(2, (heads, -1)).sum(3) if grad.numel() else grad
                for grad in (grad_points, grad_weights)
            )
        return (
            grad_values if wants_values else None,
            grad_points if wants_points else None,
            grad_weights if wants_weights else None,
            None,
        )
