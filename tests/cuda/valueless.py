"""A card without values: tensors on PyTorch's device "meta", which have sizes alone.

A step at full size takes no memory and little time there. Rules of devices are those of `emulated_card`.
Where the host asks for values, it gets ones; where their number depends on values, all count.
"""

from typing import Any

import torch
from emulated_card import INDEXING, aten, device_of
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

CARD = torch.device("meta")


def on_card(value: object) -> bool:
    return isinstance(value, Tensor) and value.device == CARD


class Valueless(TorchDispatchMode):
    """Operations on the card and beside it."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if not device_of(func, args, kwargs, on_card):
            return func(*args, **kwargs)
        if func is aten._local_scalar_dense.default:
            return torch.ones((), dtype=args[0].dtype).item()
        if func is aten.nonzero.default:
            return torch.empty(args[0].numel(), args[0].dim(), dtype=torch.int64, device=CARD)
        if func is aten.equal.default:
            return True
        if func is aten._to_copy.default and torch.device(kwargs.get("device") or CARD) != CARD:
            return torch.ones(args[0].shape, dtype=kwargs.get("dtype") or args[0].dtype)
        if func in INDEXING:
            args = (args[0], [part for index in args[1] for part in _indices(index)], *args[2:])
        return func(*args, **kwargs)


def _indices(index: Tensor | None) -> list[Tensor | None]:
    """Return indices on the card. A mask becomes those of all its places."""
    if index is None:
        return [None]
    if index.dtype not in (torch.bool, torch.uint8):
        return [index.to(CARD)]
    return [torch.empty(index.numel(), dtype=torch.int64, device=CARD) for _ in range(index.dim())]
