"""Colours that have to be told apart are different for people with each kind of colour blindness."""

import itertools

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from foredrive.view import palette

SEEN_BY = {
    "protanopia": (
        (0.152286, 1.052583, -0.204868),
        (0.114503, 0.786281, 0.099216),
        (-0.003882, -0.048116, 1.051998),
    ),
    "deuteranopia": (
        (0.367322, 0.860646, -0.227968),
        (0.280085, 0.672501, 0.047413),
        (-0.011820, 0.042940, 0.968881),
    ),
    "tritanopia": (
        (1.255528, -0.076749, -0.178779),
        (-0.078411, 0.930809, 0.147602),
        (0.004733, 0.691367, 0.303900),
    ),
}
"""Linear RGB as it is seen (Machado et al., 2009, severity 1)."""
GROUPS = {
    "occupancy": (palette.TRUE_POSITIVE, palette.FALSE_POSITIVE, palette.FALSE_NEGATIVE, palette.KNOWN_FREE),
    "paths": (palette.EXPERT, palette.PLAN, palette.GROUND),
}
FAR = 30.0
"""ΔE of CIE 1976; about 2 is just noticeable side by side."""


def lab(linear: np.ndarray) -> np.ndarray:
    """CIE L*a*b* of linear sRGB under D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(to_xyz @ linear.clip(0.009, 1) / np.array([0.9505, 1.0, 1.089]))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("blindness", SEEN_BY)
@pytest.mark.parametrize("group", GROUPS)
def test_colours_differ_for_everyone(group: str, blindness: str) -> None:
    seen = []
    for colour in GROUPS[group]:
        value = np.array(to_rgb(colour))
        linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
        seen.append(lab(np.array(SEEN_BY[blindness]) @ linear))
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > FAR
