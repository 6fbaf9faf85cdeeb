"""Slots of road users: records that hold one array per property, with a row for each slot."""

import dataclasses
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Int

SlotsType = TypeVar("SlotsType", bound="Slots")


@dataclass(frozen=True)
class Slots:
    """N slots. The values of a slot that is not `active` have no meaning."""

    active: Bool[np.ndarray, "N"]
    track_id: Int[np.ndarray, "N"]
    style: Int[np.ndarray, "N"]

    def rows(self: SlotsType, rows: slice | Int[np.ndarray, "k"]) -> SlotsType:
        """Return some of the slots."""
        return dataclasses.replace(self, **{name: value[rows] for name, value in vars(self).items()})

    def appended(self: SlotsType, more: SlotsType) -> SlotsType:
        """Return the slots with those of `more` appended."""
        both = {name: np.concatenate([value, getattr(more, name)]) for name, value in vars(self).items()}
        return dataclasses.replace(self, **both)

    def replace_rows(self: SlotsType, rows: Int[np.ndarray, "k"], other: SlotsType) -> SlotsType:
        """Return the slots with `rows` replaced by the k slots of `other`."""
        changed = {name: value.copy() for name, value in vars(self).items()}
        for name, value in changed.items():
            value[rows] = getattr(other, name)
        return dataclasses.replace(self, **changed)
