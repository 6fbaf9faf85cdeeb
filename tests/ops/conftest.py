"""How a fast path is held against its reference."""

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import pytest
import torch
from torch import Tensor

Op = Callable[..., Tensor]
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def gradients(op: Op, inputs: Sequence[Tensor], wanted: Sequence[bool]) -> list[Tensor]:
    """Value, then the gradients of a fixed random functional of it for the inputs that want one."""
    inputs = [x.detach().clone().requires_grad_(w) for x, w in zip(inputs, wanted, strict=True)]
    out = op(*inputs)
    if not any(wanted):
        return [out]
    upstream = torch.randn(out.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    found = torch.autograd.grad(out, [x for x in inputs if x.requires_grad], upstream.to(out.dtype))
    return [out.detach(), *found]


def check_parity(
    fast: Op, reference: Op, inputs: Sequence[Tensor], wanted: Sequence[bool] | None = None
) -> None:
    """Value and gradients agree to float32 accuracy, relative to the largest entry."""
    wanted = wanted or [True] * len(inputs)
    for i, (a, b) in enumerate(
        zip(gradients(fast, inputs, wanted), gradients(reference, inputs, wanted), strict=True)
    ):
        assert a.dtype == b.dtype
        scale = b[b.isfinite()].abs().max().item() if b.isfinite().any() else 1.0
        torch.testing.assert_close(
            a,
            b,
            rtol=1e-4,
            atol=2e-5 * max(scale, 1e-3),
            equal_nan=True,
            msg=lambda m, i=i: f"output {i}: {m}",
        )


def load_triton_op(module: str, name: str) -> Op:
    """A Triton op for tensors on the CPU; computed on the GPU where there is one, interpreted elsewhere."""
    pytest.importorskip("triton", reason="Triton is not installed")
    op = getattr(import_module(f"foredrive.ops.{module}"), name)

    def moved(x: Any) -> Any:
        if isinstance(x, list):
            return [tensor.to(DEVICE) for tensor in x]
        return x.to(DEVICE) if isinstance(x, Tensor) else x

    return lambda *inputs: op(*map(moved, inputs)).cpu()


@pytest.fixture(scope="session")
def triton_op() -> Callable[[str, str], Op]:
    """See `load_triton_op`."""
    return load_triton_op


@pytest.fixture(scope="session")
def parity() -> Callable[..., None]:
    """See `check_parity`."""
    return check_parity


def guarded(values: Tensor) -> Tensor:
    """The same values, contiguous, in the middle of a memory full of NaN: reading outside shows."""
    margin = max(4096, values.numel())
    memory = torch.full((values.numel() + 2 * margin,), torch.nan)
    inside = memory[margin : margin + values.numel()].view(values.shape)
    return inside.copy_(values)


@pytest.fixture(scope="session")
def guard() -> Callable[[Tensor], Tensor]:
    """See `guarded`."""
    return guarded


WILD = torch.tensor([-torch.inf, -3e38, -(2.0**31), -1e9, -1.5, 1e9, 2.0**31, 2.0**63, 3e38, torch.inf])
"""Coordinates that must read zero, wherever they are."""


@pytest.fixture(scope="session")
def wild() -> Tensor:
    """See `WILD`."""
    return WILD
