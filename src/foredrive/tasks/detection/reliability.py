"""Reliability of confidences: how far they are from the outcomes."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped
from numpy import ndarray


@dataclass(frozen=True)
class Reliability:
    """Confidences and outcomes in bins of equal width."""

    count: Int[ndarray, "bins"]
    confidence: Float[ndarray, "bins"]
    """Mean in the bin; NaN if it is empty."""
    outcome: Float[ndarray, "bins"]
    """Mean in the bin: the share of hits, or the mean overlap."""

    @property
    def error(self) -> float:
        """Mean |outcome - confidence|, bins weighted by their share; NaN if all are empty.

        D-ECE (Küppers et al. 2020) where outcomes are hits. LaECE of one class (Oksuz et al. 2023) where
        they are the overlap of hits and 0 elsewhere; LaECE₀ (Kuzucu et al. 2024) where any overlap is a hit.
        """
        full = self.count > 0
        if not full.any():
            return math.nan
        gap = np.abs(self.outcome[full] - self.confidence[full])
        return float((gap * self.count[full]).sum() / self.count.sum())


def reliability(
    confidence: Float[ndarray, "n"], outcome: Shaped[ndarray, "n"], bins: int = 25
) -> Reliability:
    """Bin confidences in [0, 1] and their outcomes; a bin holds its upper edge."""
    # ceil - 1 puts an upper edge into its own bin; 0 goes into the first one
    which = np.clip(np.ceil(confidence * bins).astype(int) - 1, 0, bins - 1)
    count = np.bincount(which, minlength=bins)
    # Empty bins give 0 / 0 = NaN
    with np.errstate(invalid="ignore"):
        mean_confidence = np.bincount(which, confidence, bins) / count
        mean_outcome = np.bincount(which, outcome.astype(float), bins) / count
    return Reliability(count, mean_confidence, mean_outcome)
