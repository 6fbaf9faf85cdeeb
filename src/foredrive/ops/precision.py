"""Conditions for the kernels of the ops."""

from functools import lru_cache
from importlib.util import find_spec

import torch
from torch import Tensor

MAX_ITEM_SIZE = 2**31
"""Upper limit of floats in one image or volume, because kernels index them with 32 bits."""


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
    """Return whether bfloat16 saves time on a device, "cpu" or "cuda".

    On CPUs that support it, a step takes a third of the time of full precision. On other CPUs it takes more
    than ten times as long. If PyTorch cannot tell, the answer is False. GPUs before Ampere (T4, V100) emulate
    it, which PyTorch reports as support.
    """
    if device != "cpu":
        return torch.cuda.get_device_capability()[0] >= 8
    capabilities: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(capabilities.get("amx_bf16") or capabilities.get("avx512_bf16"))
