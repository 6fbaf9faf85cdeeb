"""The base class of the scene types: frozen dataclasses of tensors that are moved and sliced together."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

R = TypeVar("R", bound="Record")


@dataclasses.dataclass(frozen=True)
class Record:
    """A frozen record. Its fields are tensors, other records, None, or constants shared by a batch."""

    def map_tensors(self: R, fn: Callable[[Tensor], Tensor]) -> R:
        """Apply `fn` to every tensor of this record and of nested records."""

        def apply(value: Any) -> Any:
            if isinstance(value, Tensor):
                return fn(value)
            return value.map_tensors(fn) if isinstance(value, Record) else value

        changed = {f.name: apply(getattr(self, f.name)) for f in dataclasses.fields(self)}
        return dataclasses.replace(self, **changed)

    def to(self: R, device: torch.device | str) -> R:
        """Move every tensor to `device`. A copy from pinned memory to a GPU goes on while the host works."""
        # Never to the host: its tensors could be read before they are there
        ahead = torch.device(device).type == "cuda"
        return self.map_tensors(lambda tensor: tensor.to(device, non_blocking=ahead))

    def pin_memory(self: R) -> R:
        """Put every tensor into pinned memory, as `DataLoader` asks for it."""
        return self.map_tensors(lambda tensor: tensor.pin_memory())

    def __getitem__(self: R, index: Any) -> R:
        """Index the leading dimension(s) of every tensor."""
        return self.map_tensors(lambda tensor: tensor[index])
