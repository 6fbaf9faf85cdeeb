"""Orders for road users, from which scenarios are made."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64


@dataclass(frozen=True)
class Orders:
    """Orders for N vehicle slots and all scripted actors. Without an order, drivers decide as usual."""

    max_mps2: Float64[np.ndarray, "N"]
    """Maximum acceleration of each vehicle, m/s²; infinite for no limit. A limited vehicle does not change
    lanes."""
    ignores_ego: Bool[np.ndarray, "N"]
    """Vehicles that drive as if vehicle 0 were not there."""
    runs_lights: Bool[np.ndarray, "N"]
    """Vehicles that enter junctions whatever a light shows."""
    scripted_mps: tuple[float, ...] = ()
    """Speed of each scripted actor, m/s."""
    change: tuple[int, int] | None = None
    """Vehicle that changes lanes now, and the side."""

    @classmethod
    def none(cls, count: int) -> "Orders":
        """Return no orders: all drive freely, and scripted actors stand."""
        free = np.zeros(count, dtype=np.bool_)
        return cls(np.full(count, np.inf), free, free.copy())

    def padded(self, count: int) -> "Orders":
        """Return the orders for `count` vehicles, with the additional ones free."""
        more = count - len(self.ignores_ego)
        return Orders(
            np.pad(self.max_mps2, (0, more), constant_values=np.inf),
            np.pad(self.ignores_ego, (0, more)),
            np.pad(self.runs_lights, (0, more)),
            self.scripted_mps,
            self.change,
        )
