"""Precision of the ops, and the conditions for their kernels."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.util import find_spec

import torch
from torch import Tensor

MAX_ITEM_SIZE = 2**31
"""Upper limit of floats in one image or volume, because kernels index them with 32 bits."""


@contextmanager
def full_precision(*tensors: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Disable autocast, and yield the tensors in float32, or in float64 if any of them is float64.

    Sampling and compositing are not faster in half precision, and positions and depths would lose accuracy.
    """
    dtype = torch.float64 if any(t.dtype == torch.float64 for t in tensors) else torch.float32
    with torch.autocast(tensors[0].device.type, enabled=False):
        yield tuple(t.to(dtype) for t in tensors)


def numba_supports(*tensors: Tensor) -> bool:
    """Return whether the CPU kernels apply: all tensors on the CPU, none float64, nothing traced."""
    return _plain(tensors, "cpu")


def triton_supports(*tensors: Tensor) -> bool:
    """Return whether the CUDA kernels apply: as `numba_supports`, but on a GPU and with Triton installed."""
    return _plain(tensors, "cuda") and _has_triton()


def _plain(tensors: tuple[Tensor, ...], device: str) -> bool:
    traced = torch.compiler.is_compiling() or torch.jit.is_tracing()
    return not traced and all(t.device.type == device and t.dtype != torch.float64 for t in tensors)


@lru_cache
def _has_triton() -> bool:
    return find_spec("triton") is not None


def computes_bfloat16(device: str) -> bool:
    """Return whether bfloat16 saves time on a device.

    On CPUs that support it, a step takes a third of the time of full precision. On other CPUs it takes more
    than ten times as long. If PyTorch cannot tell, the answer is False.
    """
    if device != "cpu":
        return True
    known: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(known.get("amx_bf16") or known.get("avx512_bf16"))
