"""The 1cycle policy of learning rate and momentum (Smith & Topin 2018)."""

import math
from dataclasses import dataclass

from foredrive.engine.ranges import check_at_least, check_shares


@dataclass(frozen=True)
class OneCycle:
    """Numbers of the policy as PyTorch's `OneCycleLR` has them, with half cosines in both phases.

    The learning rate rises from `1 / initial_div` of its maximum to the maximum, and falls to `1 / final_div`
    of where it began. Adam's first beta falls and rises again.
    """

    rise_share: float = 0.1
    """Share of the steps in which the learning rate rises."""
    initial_div: float = 25.0
    """Maximum of the learning rate divided by the rate at the beginning."""
    final_div: float = 1e4
    """Learning rate at the beginning divided by the rate at the end."""
    betas: tuple[float, float] = (0.85, 0.95)
    """Adam's first beta at the maximum of the learning rate, and at both ends."""

    def __post_init__(self) -> None:
        """Check the numbers' ranges."""
        check_shares(self, "rise_share")
        check_at_least(self, initial_div=1, final_div=1, betas=0)

    def at(self, step: int, total: int) -> tuple[float, float]:
        """Return the share of the maximum learning rate, and Adam's first beta, at step (from 0) of total."""
        start, (low, high) = 1 / self.initial_div, self.betas
        # The last step of the rise, as a fractional step, as in PyTorch
        peak = self.rise_share * total - 1
        if step < peak:
            return _between(start, 1.0, step / peak), _between(high, low, step / peak)
        fallen = (step - peak) / max(total - 1 - peak, 1)
        return _between(1.0, start / self.final_div, fallen), _between(low, high, fallen)


def _between(first: float, last: float, share: float) -> float:
    return last + (first - last) * 0.5 * (1 + math.cos(math.pi * share))
