"""Which numbers the ops compute in, and which kernels can."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.util import find_spec

import torch
from torch import Tensor

MAX_ITEM_SIZE = 2**31
"""Kernels count floats within one image or volume in 32 bits."""


@contextmanager
def full_precision(*tensors: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Autocast off, and the tensors in float32, or in float64 if any of them is.

    Sampling and compositing gain nothing from half precision, and lose places and depths.
    """
    dtype = torch.float64 if any(t.dtype == torch.float64 for t in tensors) else torch.float32
    with torch.autocast(tensors[0].device.type, enabled=False):
        yield tuple(t.to(dtype) for t in tensors)


def numba_can(*tensors: Tensor) -> bool:
    """Whether CPU kernels can take these: on the CPU, not in float64, and nobody traces the call."""
    return _plain(tensors, "cpu")


def triton_can(*tensors: Tensor) -> bool:
    """Whether CUDA kernels can take these: as `numba_can`, but on a GPU, and if there is Triton."""
    return _plain(tensors, "cuda") and _has_triton()


def _plain(tensors: tuple[Tensor, ...], device: str) -> bool:
    traced = torch.compiler.is_compiling() or torch.jit.is_tracing()
    return not traced and all(t.device.type == device and t.dtype != torch.float64 for t in tensors)


@lru_cache
def _has_triton() -> bool:
    return find_spec("triton") is not None


def computes_bfloat16(device: str) -> bool:
    """Whether bfloat16 saves time: on CPUs that know it a step takes a third of that in full precision, on
    others more than ten times as long. A PyTorch that does not tell takes full precision."""
    if device != "cpu":
        return True
    known: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(known.get("amx_bf16") or known.get("avx512_bf16"))
