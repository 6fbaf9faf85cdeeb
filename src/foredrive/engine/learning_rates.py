"""Learning rates of a scene's parameters over the steps of its training."""

import math
from dataclasses import dataclass

from foredrive.engine.ranges import check_at_least


@dataclass(frozen=True)
class Rate:
    """A learning rate that rises as the first quarter of a sine, then decays exponentially."""

    first: float
    """Rate after the warm-up. 0 leaves the parameters unchanged."""
    final: float = 0.1
    """Rate at the end, as a fraction of `first`."""
    warmup_steps: int = 0
    """Steps in which the rate rises from 0 to `first`."""
    until_step: int | None = None
    """Step of the final rate, which stays until the end; None: the last step of the training."""

    def __post_init__(self) -> None:
        """Check the numbers' ranges."""
        check_at_least(self, first=0, final=0, warmup_steps=0, until_step=0)

    def at(self, step: int, steps: int) -> float:
        """Return the rate at a step of a training of `steps` steps."""
        if step < self.warmup_steps:
            return self.first * math.sin(0.5 * math.pi * step / self.warmup_steps)
        decaying = max((self.until_step or steps) - self.warmup_steps, 1)
        return self.first * float(self.final ** min((step - self.warmup_steps) / decaying, 1.0))
