"""Weights in 8 bits, a quarter of their size, for models that come with the package."""

from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Float, Int8
from safetensors.torch import save_file
from torch import Tensor, nn

SCALE = ".scale"
"""Suffix of the scales of a tensor in 8 bits."""
LEVELS = 127


def save_small(model: nn.Module, path: Path) -> None:
    """Write a model's weights: matrices and filters in 8 bits, all other floating-point values in 16.

    Each row (output channel) of a matrix or filter has a scale of its own, so no value changes by more than
    1/254 of the largest in its row. `load_weights` reads such files too.
    """
    entries: dict[str, Tensor] = {}
    for name, value in model.state_dict().items():
        if value.is_floating_point() and value.dim() > 1:
            entries[name], entries[name + SCALE] = _in_8_bits(value.detach())
        # Values beyond the range of float16 stay in 32 bits
        elif value.is_floating_point() and value.abs().max() < torch.finfo(torch.float16).max:
            entries[name] = value.detach().half().contiguous()
        else:
            entries[name] = value.detach().contiguous()
    save_file(entries, path)


def _in_8_bits(value: Float[Tensor, "..."]) -> tuple[Int8[Tensor, "..."], Float[Tensor, "..."]]:
    rows = value.float().flatten(1)
    # A row of zeros gets a tiny scale instead of a division by zero
    scale = rows.abs().amax(1, keepdim=True).clamp_min(1e-12) / LEVELS
    codes = (rows / scale).round_().to(torch.int8).view(value.shape)
    return codes.contiguous(), scale.view(-1, *[1] * (value.dim() - 1)).contiguous()


def full_precision(saved: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return 8-bit weights of a file as 32-bit values. All other weights are returned unchanged."""
    return {
        name: value.float() * saved[name + SCALE] if name + SCALE in saved else value
        for name, value in saved.items()
        if not name.endswith(SCALE)
    }
