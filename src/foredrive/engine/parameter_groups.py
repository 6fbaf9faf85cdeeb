"""Parameters with and without weight decay."""

from typing import Any

from torch import nn
from torch.nn.modules.conv import _ConvNd

_DECAYED = (nn.Linear, _ConvNd, nn.MultiheadAttention, nn.RNNCellBase)
"""Modules whose weights are matrices or filters; attention has its projections in its own weights."""


def parameter_groups(module: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Return the trainable parameters as two groups of an optimiser: with weight decay and without.

    Weights of linear layers, convolutions, projections of attention and recurrent cells decay. Norms, biases,
    embeddings, queries and other single parameters do not.
    """
    decayed: list[nn.Parameter] = []
    kept: list[nn.Parameter] = []
    seen: set[nn.Parameter] = set()
    for part in module.modules():
        for name, parameter in part.named_parameters(recurse=False):
            # Shared parameters belong to the first module that has them
            if not parameter.requires_grad or parameter in seen:
                continue
            seen.add(parameter)
            (decayed if isinstance(part, _DECAYED) and "weight" in name else kept).append(parameter)
    return [{"params": decayed, "weight_decay": weight_decay}, {"params": kept, "weight_decay": 0.0}]
