"""Orders for road users, from which scenarios are made."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64


@dataclass(frozen=True)
class Orders:
    """Orders for N vehicle slots and all strays. Without an order, drivers decide as usual."""

    most_mps2: Float64[np.ndarray, "N"]
    """Maximum acceleration of each vehicle, m/s²; infinite for no limit. A limited vehicle does not change
    lanes."""
    blind: Bool[np.ndarray, "N"]
    """Vehicles that drive as if vehicle 0 were not there."""
    runs: Bool[np.ndarray, "N"]
    """Vehicles that enter junctions whatever a light shows."""
    pace_mps: tuple[float, ...] = ()
    """Speed of each stray, m/s."""
    change: tuple[int, int] | None = None
    """Vehicle that changes lanes now, and the side."""

    @classmethod
    def none(cls, count: int) -> "Orders":
        """Return no orders: all drive freely, and strays stand."""
        free = np.zeros(count, dtype=np.bool_)
        return cls(np.full(count, np.inf), free, free.copy())

    def padded(self, count: int) -> "Orders":
        """Return the orders for `count` vehicles, with the additional ones free."""
        more = count - len(self.blind)
        return Orders(
            np.pad(self.most_mps2, (0, more), constant_values=np.inf),
            np.pad(self.blind, (0, more)),
            np.pad(self.runs, (0, more)),
            self.pace_mps,
            self.change,
        )
