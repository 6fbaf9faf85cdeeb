"""Orders from outside for some of the traffic: what scenarios are made of."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64


@dataclass(frozen=True)
class Orders:
    """For N vehicle slots and all strays. Whatever is not ordered, drivers decide as ever."""

    most_mps2: Float64[np.ndarray, "N"]
    """Nobody accelerates more than this; infinite: as he likes. Who is held back changes no lanes."""
    blind: Bool[np.ndarray, "N"]
    """Who drives as if vehicle 0 were not there."""
    runs: Bool[np.ndarray, "N"]
    """Who enters junctions whatever a light shows."""
    pace_mps: tuple[float, ...] = ()
    """How fast each stray goes."""
    change: tuple[int, int] | None = None
    """Who changes lanes now, and to which side."""

    @classmethod
    def none(cls, count: int) -> "Orders":
        """Everybody as he likes; strays stand."""
        free = np.zeros(count, dtype=np.bool_)
        return cls(np.full(count, np.inf), free, free.copy())

    def padded(self, count: int) -> "Orders":
        """The same with free vehicles behind, `count` in all."""
        more = count - len(self.blind)
        return Orders(
            np.pad(self.most_mps2, (0, more), constant_values=np.inf),
            np.pad(self.blind, (0, more)),
            np.pad(self.runs, (0, more)),
            self.pace_mps,
            self.change,
        )
