"""What is in the air: how fog and rain dim light and lidar pulses, and what they send back."""

from typing import NamedTuple

from foredrive.towns.conditions import Conditions

CONTRAST_LOST = 3.912
"""-ln 0.02: visibility times extinction, by Koschmieder."""
FOG_BELOW_M = 1000.0
HAZE_AT_905_NM = (0.55 / 0.905) ** 1.3
"""Haze is finer than fog and dims a lidar less (Kruse, Elements of Infrared Technology, 1962)."""
RAIN_EXTINCTION, RAIN_POWER = 3.6e-4, 0.63
BACKSCATTER_RATIO = 0.0154
"""Of extinction, 1/sr: 0.046 / V against 2.996 / V (Rasshofer et al., Advances in Radio Science 9, 2011)."""


class AirArrays(NamedTuple):
    """Air and wetness, for kernels."""

    foggy: bool
    extinction_per_m: float
    """Of visible light."""
    lidar_extinction_per_m: float
    """Of a lidar's near-infrared light, one way."""
    backscatter_per_m_sr: float
    """Share of a lidar pulse that the air sends straight back, for each metre and steradian."""
    drops: float
    """Rain rate, mm/h: raindrops come in single echoes, fog in a curtain."""
    wetness: float
    """Of the ground, 0 to 1."""


def rain_extinction_per_m(rain_mmph: float) -> float:
    """What rain takes of a lidar's pulse one way.

    Drops are far larger than the wavelength and take twice their cross-section: the integral of π D²/2 over
    N(D) = 8000 exp(-4.1 R^-0.21 D) per m³ and mm (Marshall & Palmer, J. Meteorology 5, 1948).
    """
    return RAIN_EXTINCTION * rain_mmph**RAIN_POWER


def make_air(conditions: Conditions) -> AirArrays:
    """Air of a weather: visible light fades as Koschmieder has it, by 3.912 / V.

    The droplets of fog are larger than either wavelength, so that 905 nm fares as visible light does. What
    rain takes is a part of what the visibility tells; the rest is haze.
    """
    extinction = CONTRAST_LOST / conditions.visibility_m
    rain = rain_extinction_per_m(conditions.rain_mmph)
    foggy = conditions.visibility_m < FOG_BELOW_M
    droplets = max(extinction - rain, 0.0)
    return AirArrays(
        foggy=foggy,
        extinction_per_m=extinction,
        lidar_extinction_per_m=rain + droplets * (1.0 if foggy else HAZE_AT_905_NM),
        backscatter_per_m_sr=BACKSCATTER_RATIO * (rain + (droplets if foggy else 0.0)),
        drops=conditions.rain_mmph,
        wetness=max(conditions.wetness, 0.5 if conditions.rain_mmph > 0.0 else 0.0),
    )
