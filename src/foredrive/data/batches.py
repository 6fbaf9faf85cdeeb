"""Collation of records: frames to a clip, examples to a batch."""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Shaped
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene import Example
from foredrive.scene.record import Record

R = TypeVar("R", bound=Record)

_PADDING = {"kind": -1, "beam": -1, "num_points": -1, "attribute": -1, "visibility": -1}
"""Padding values of fields. All other fields are padded with 0 (False)."""


def collate(examples: Sequence[Example]) -> Example:
    """Collate examples to a batch. Boxes, beams and polylines are padded to the maximum in the batch.

    Raises:
        InputError: the examples differ in cameras or grid.
    """
    keys = tuple(key for example in examples for key in example.key)
    batch = stack_records([dataclasses.replace(example, key=()) for example in examples])
    return dataclasses.replace(batch, key=keys)


def stack_records(records: Sequence[R]) -> R:
    """Stack the tensors of records along a new first dimension. Tensors of different sizes are padded.

    Raises:
        InputError: constants of the records (names, sizes, grids) differ.
    """
    changed = {}
    for field in dataclasses.fields(records[0]):
        values = [getattr(record, field.name) for record in records]
        changed[field.name] = _stack_values(field.name, values)
    return dataclasses.replace(records[0], **changed)


def _stack_values(name: str, values: list[Any]) -> Any:
    if isinstance(values[0], Tensor):
        return _stack_padded(values, _PADDING.get(name, 0))
    if isinstance(values[0], Record):
        return stack_records(values)
    if any(value != values[0] for value in values):
        raise InputError(f"items of one batch differ in {name}: {sorted({repr(v) for v in values})}")
    return values[0]


def _stack_padded(tensors: list[Shaped[Tensor, "..."]], padding: int) -> Shaped[Tensor, "..."]:
    if all(tensor.shape == tensors[0].shape for tensor in tensors):
        return torch.stack(tensors)
    shape = [max(sizes) for sizes in zip(*(tensor.shape for tensor in tensors), strict=True)]
    out = tensors[0].new_full((len(tensors), *shape), padding)
    for row, tensor in zip(out, tensors, strict=True):
        row[tuple(slice(size) for size in tensor.shape)] = tensor
    return out
