"""A hint where results agree far better with the truth when their axes are swapped or reversed."""

import itertools
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Shaped
from numpy import ndarray

MAX_FRAMES = 20
"""Number of frames that are tried; axes are the same in all frames of a file."""
MIN_GAIN, MIN_RATIO = 0.1, 1.5
"""Agreement has to grow by both."""
_log = logging.getLogger(__name__)


class Turn(NamedTuple):
    """A change of the axes over ground: first x and y are swapped, then axes are reversed."""

    swapped: bool
    x_reversed: bool
    y_reversed: bool

    @property
    def words(self) -> str:
        """Return the change in words, such as "x and y swapped, then y reversed"."""
        axes = " and ".join(name for name, turned in (("x", self[1]), ("y", self[2])) if turned)
        return ", then ".join(["x and y swapped"] * self.swapped + [f"{axes} reversed"] * bool(axes))

    def of_points(self, points_m: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """Return points with the axes changed."""
        signs = np.where(self[1:], -1.0, 1.0)
        return (points_m[..., ::-1] if self.swapped else points_m) * signs

    def of_grid(self, cells: Shaped[ndarray, "*n Y X"]) -> Shaped[ndarray, "*n Y X"]:
        """Return a grid around the ego vehicle, as many cells along x as along y, with the axes changed."""
        turned = cells.swapaxes(-1, -2) if self.swapped else cells
        return turned[..., :: -1 if self.y_reversed else 1, :: -1 if self.x_reversed else 1]


TURNS = [Turn(*flags) for flags in itertools.product((False, True), repeat=3) if any(flags)]


def tell_if_turned(path: Path, what: str, given: float, turned: Mapping[Turn, float]) -> None:
    """Say in one line under which change of axes the results agree far better with the truth, if any.

    Args:
        path: the results.
        what: the figure.
        given, turned: its value, as given and by change of axes, 0 to 1.
    """
    turn, best = max(turned.items(), key=lambda item: item[1])
    if best >= given + MIN_GAIN and best >= MIN_RATIO * given:
        _log.warning(
            "%s: its axes seem to be others: with %s, %s would be %.0f %% instead of %.0f %%",
            path, turn.words, what, 100 * best, 100 * given,
        )  # fmt: skip
