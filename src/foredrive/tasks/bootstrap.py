"""Bootstrap interval of a mean over frames, where frames of one sequence resemble each other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from foredrive.errors import InputError

LEAST_ROUTES = 10
"""Routes of closed-loop drives below which there is no interval over them.

Percentile intervals of few values are too narrow: of 5 normal values those of 95 % hold the true mean in
82 % of cases, of 10 in 90 %, of 32 in 93 %; of values that are mostly 0 in 68 %, 84 % and 92 %.
"""
NO_INTERVAL = f"Of fewer than {LEAST_ROUTES} routes there are no intervals: they would be too narrow."


@dataclass(frozen=True)
class BootstrapMean:
    """A mean and its interval over resampled sequences."""

    mean: float
    low: float
    high: float
    p_value: float
    """Two-sided, of the mean being 0: how often it is as large if every sequence has a sign by chance.

    Few sequences cannot be significant: of n, no p-value is below 2^(1 - n) but for chance.
    """


def bootstrap_mean(
    values: Float[ndarray, "n"],
    sequence: Sequence[str],
    rng: np.random.Generator,
    *,
    level: float = 0.95,
    resamples: int = 2000,
    least: int = 2,
) -> BootstrapMean:
    """Return the percentile interval of the mean over frames, by drawing whole sequences with replacement.

    The p-value of paired differences tests whether two detectors differ, by a randomisation test (Fisher
    1935): resampled means would call any two sequences that agree significant. With one sequence there is
    nothing to draw from, and interval and p-value are NaN. With fewer than `least` sequences the interval is.

    Raises:
        InputError: without values, or if any is not finite.
    """
    if len(values) == 0 or not np.isfinite(values).all():
        raise InputError("a mean needs values, all of them finite")
    # Sum and number of frames of each sequence: resampled means need nothing else
    _, which = np.unique(np.asarray(sequence), return_inverse=True)
    total, count = np.bincount(which, values), np.bincount(which)
    mean = float(values.mean())
    if len(total) < 2:
        return BootstrapMean(mean, np.nan, np.nan, np.nan)
    # Whole sequences with replacement; the mean weighs every frame equally
    drawn = rng.integers(0, len(total), (resamples, len(total)))
    means = total[drawn].sum(1) / count[drawn].sum(1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    # Randomisation test: flip the sign of every sequence's sum at random
    by_chance = np.abs(rng.choice([-1.0, 1.0], (resamples, len(total))) @ total)
    # The tolerance counts sums that are equal but for rounding
    as_large = by_chance >= (1 - 1e-9) * abs(total.sum())
    # The observed signs are one of the draws, hence + 1
    p_value = float((as_large.sum() + 1) / (resamples + 1))
    if len(total) < least:
        low = high = np.nan
    return BootstrapMean(mean, float(low), float(high), p_value)
