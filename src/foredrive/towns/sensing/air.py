"""Air: how fog and rain attenuate light and lidar pulses, and how much they scatter back."""

from typing import NamedTuple

from foredrive.scene.conditions import Conditions

CONTRAST_LOST = 3.912
"""-ln 0.02: the product of visibility and extinction (Koschmieder)."""
FOG_BELOW_M = 1000.0
HAZE_AT_905_NM = (0.55 / 0.905) ** 1.3
"""Haze extinction at 905 nm relative to visible light. Haze particles are finer than fog and attenuate a
lidar less (Kruse, Elements of Infrared Technology, 1962)."""
RAIN_EXTINCTION, RAIN_POWER = 3.6e-4, 0.63
BACKSCATTER_RATIO = 0.0154
"""Ratio of backscatter to extinction, 1/sr: 0.046 / V against 2.996 / V (Rasshofer et al., Advances in Radio
Science 9, 2011)."""


class AirArrays(NamedTuple):
    """Air and wetness, as arguments of compiled functions."""

    foggy: bool
    extinction_per_m: float
    """Extinction of visible light, 1/m."""
    lidar_extinction_per_m: float
    """Extinction of a lidar's near-infrared light, one way, 1/m."""
    backscatter_per_m_sr: float
    """Share of a lidar pulse that the air scatters straight back, per metre and steradian."""
    rain_mmph: float
    """Rain rate, mm/h. Raindrops give single echoes, fog gives a continuous one."""
    wetness: float
    """Wetness of the ground, 0 to 1."""


def rain_extinction_per_m(rain_mmph: float) -> float:
    """Return the extinction of a lidar pulse by rain, one way, 1/m.

    Drops are far larger than the wavelength and remove twice their cross-section: the integral of π D²/2 over
    N(D) = 8000 exp(-4.1 R^-0.21 D) per m³ and mm (Marshall & Palmer, J. Meteorology 5, 1948).
    """
    return RAIN_EXTINCTION * rain_mmph**RAIN_POWER


def make_air(conditions: Conditions) -> AirArrays:
    """Make the air of a weather. Visible light is attenuated with 3.912 / V (Koschmieder).

    Fog droplets are larger than both wavelengths, so light of 905 nm is attenuated as visible light is.
    Extinction by rain is a part of the extinction that follows from the visibility; the rest is haze.
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
        rain_mmph=conditions.rain_mmph,
        wetness=max(conditions.wetness, 0.5 if conditions.rain_mmph > 0.0 else 0.0),
    )
