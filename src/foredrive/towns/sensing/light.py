"""The light of a time of day and a weather: sun, sky, haze, and the exposure of the cameras."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from foredrive.scene.conditions import Conditions
from foredrive.towns.sensing.lamps import NO_LAMPS, UNIT_LUX, LampArrays
from foredrive.towns.sensing.sky import FOG_TOP_M

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
    # Koschmieder: extinction = 3.912 / visibility
    extinction = CONTRAST_LOST / conditions.visibility_m
    rain = rain_extinction_per_m(conditions.rain_mmph)
    foggy = conditions.visibility_m < FOG_BELOW_M
    droplets = max(extinction - rain, 0.0)
    return AirArrays(
        foggy=foggy,
        extinction_per_m=extinction,
        # Fog attenuates the lidar as it does visible light, haze less; rain by its own law
        lidar_extinction_per_m=rain + droplets * (1.0 if foggy else HAZE_AT_905_NM),
        backscatter_per_m_sr=BACKSCATTER_RATIO * (rain + (droplets if foggy else 0.0)),
        rain_mmph=conditions.rain_mmph,
        wetness=max(conditions.wetness, 0.5 if conditions.rain_mmph > 0.0 else 0.0),
    )


Rgb = Float32[np.ndarray, "3"]

NOON_ELEVATION_DEG = 60.0
SUN_OUTSIDE_RGB = (1.93, 1.96, 1.93)
"""Sunlight before it passes the air: 127.5 klx (IES Lighting Handbook, 2000)."""
AIR_DEPTH_RGB = (0.17, 0.21, 0.29)
"""Optical depth of clear air at the zenith, by colour."""
_ELEVATION_DEG = (-18.0, -12.0, -6.0, 0.0, 5.0, 15.0, 30.0, 60.0)
_SKY_LUX = (1e-3, 8e-3, 3.4, 450.0, 5.4e3, 8.7e3, 1.18e4, 1.52e4)
"""Light of a clear sky on level ground, lx: 0.8 + 15.5 √sin h klx (IES Lighting Handbook, 2000); twilight:
Explanatory Supplement to the Astronomical Almanac, 1992."""
SUNLIT_CLOUD = 0.45
"""Brightness of sunlit clouds from below, relative to level white ground in the same light."""
TOWN_GLOW_LUX, TOWN_GLOW_CLOUDED_LUX = 0.12, 0.5
"""Light that the sky above a lit town scatters back at night, lx: clear and overcast."""
STREET_LUX = 6.5
"""Mean light of a lit street and its dark surroundings, lx. Cameras expose for it at night."""
GREY_SKY_METERED = 0.18
"""Reduction of the exposure under an overcast sky that is brighter than everything else."""
LIT_STREET_AMBIENT_LUX = 0.9
"""Light that lit roads and walls scatter to their surroundings, lx."""
LAMPS_BELOW_LUX, HEADLIGHTS_BELOW_LUX = 500.0, 9e3
HEADLIGHTS_BELOW_M = 3000.0
"""Visibility below which drivers turn their lights on, m."""
NOON_WHITE, NOON_EXPOSURE = 1.6, 0.6
NOON_SKY = 0.32
"""Light of a clear sky that has the colours of `_sky_colours`."""
ADAPTATION = 0.82
"""Exponent of the cameras' adaptation. With 1, every night would look as bright as day."""


class LightArrays(NamedTuple):
    """Light as linear radiances. The unit is the radiance of a white diffuse surface under `UNIT_LUX`."""

    sun: Rgb
    """Unit direction towards the sun; zeros where it casts no shadows."""
    sun_rgb: Rgb
    glow_direction: Rgb
    """Unit direction towards the brightest part of the sky."""
    glow_rgb: Rgb
    """Glow of the sky around the sun."""
    zenith: Rgb
    horizon: Rgb
    cloud_rgb: Rgb
    clouds: float
    """Cloud cover, 0 (clear) to 1 (overcast)."""
    sky_rgb: Rgb
    """Light from above on a level surface in the shade."""
    bounce_rgb: Rgb
    """Light from below."""
    street_rgb: Rgb
    """Radiance that horizontal rays show in a mirror."""
    haze_rgb: Rgb
    air: AirArrays
    lamps: LampArrays
    """Lamps of streets and vehicles; none by day."""
    lit_windows: float
    """Share of the windows with a lit room behind them."""
    glow: float
    """Radiance of white surfaces that emit light. They are bright in the image by day and by night."""
    exposure: float
    """Exposure of the cameras."""


def sun_direction(hour: float, east_rad: float) -> Rgb:
    """Return the unit vector towards the sun at a solar time.

    The sun rises in the east at 6 and sets in the west at 18.

    At noon it stands 60° high in the south, as on an equinox at 30° north. `east_rad` is the direction of
    east, counter-clockwise from the world's x, rad.
    """
    # Angle of the sun on its circle: 0 at 6 o'clock, π at 18
    angle, highest = np.pi * (hour - 6.0) / 12.0, np.deg2rad(NOON_ELEVATION_DEG)
    east, south = np.cos(angle), np.sin(angle) * np.cos(highest)
    # From east and south to the axes of the world
    cos, sin = np.cos(east_rad), np.sin(east_rad)
    xyz = (east * cos + south * sin, east * sin - south * cos, np.sin(angle) * np.sin(highest))
    return np.array(xyz, dtype=np.float32)


class _Daylight(NamedTuple):
    elevation_deg: float
    beam: Rgb
    """Sunlight before clouds and fog."""
    through: float
    """Share of the sunlight that passes clouds and fog."""
    clear: float
    """Light of a clear sky on level ground."""
    cloud: float
    """Radiance of the clouds."""
    sky: float
    """Light of the present sky on level ground."""
    white: float
    """Radiance of level white ground."""


def _daylight(conditions: Conditions) -> _Daylight:
    """Compute the light of sun and sky.

    Clouds attenuate both together by 1 - 0.75 N^3.4 (Kasten & Czeplak, Solar Energy 24, 1980). A cloud cover
    above one half begins to hide the sun.
    """
    height = float(sun_direction(conditions.hour, 0.0)[2])
    elevation_deg, clouds = math.degrees(math.asin(height)), conditions.clouds
    # Beam: sunlight after the air; level: its part on level ground
    beam = _sun_rgb(elevation_deg)
    level = float(beam[1]) * max(height, 0.0)
    # Light of the clear sky by interpolation of its logarithm over the elevation
    clear_sky = 10 ** float(np.interp(elevation_deg, _ELEVATION_DEG, np.log10(_SKY_LUX))) / UNIT_LUX
    # Share of the sun that passes clouds, and then fog on the slant way
    through = min(max((0.9 - clouds) / 0.3, 0.0), 1.0)
    through *= math.exp(-CONTRAST_LOST / conditions.visibility_m * FOG_TOP_M / max(height, 0.05))
    through = through if through > 0.02 else 0.0
    # Clouds are lit from above where the sun passes, else they are grey
    dimmed = (1.0 - 0.75 * clouds**3.4) * (level + clear_sky)
    cloud = through * SUNLIT_CLOUD * (level + clear_sky) + (1.0 - through) * dimmed
    sky = (1.0 - clouds) * clear_sky + clouds * cloud
    return _Daylight(elevation_deg, beam, through, clear_sky, cloud, sky, through * level + sky)


def daylight_lux(conditions: Conditions) -> float:
    """Return the light of sun and sky on level ground, lx."""
    return _daylight(conditions).white * UNIT_LUX


def make_light(conditions: Conditions, east_rad: float) -> LightArrays:
    """Compute the light of a time of day and a weather, without lamps."""
    toward, clouds = sun_direction(conditions.hour, east_rad), conditions.clouds
    fall = _daylight(conditions)
    beam, sky, through, white_lux = fall.beam, fall.sky, fall.through, fall.white * UNIT_LUX
    behind = (1.0 - clouds) * fall.clear + clouds * sky  # of the sky between the clouds
    level_sun = beam * max(float(toward[2]), 0.0)
    town = TOWN_GLOW_LUX + clouds * (TOWN_GLOW_CLOUDED_LUX - TOWN_GLOW_LUX)
    # By night: glow of the town, scattered light of lit roads, and exposure for a lit street
    dark = white_lux < LAMPS_BELOW_LUX
    night = _rgb(1.0, 0.80, 0.62) * np.float32((town + LIT_STREET_AMBIENT_LUX) / UNIT_LUX if dark else 0.0)
    white = (white_lux + (STREET_LUX if dark else 0.0)) / UNIT_LUX
    # Cameras adapt incompletely: nights stay darker than days
    exposure = NOON_EXPOSURE * (NOON_WHITE / white) ** ADAPTATION
    exposure *= 1.0 - (0.0 if dark else GREY_SKY_METERED * clouds**2)
    colours = _sky_colours(fall.elevation_deg, clouds)
    glow_lux = _rgb(0.92, 0.80, 0.74) * np.float32(town / UNIT_LUX if dark else 0.0)
    # Haze shows the light of the sky and a part of the sun's
    veiled = (_rgb(0.46, 0.50, 0.55) + colours.sky) * np.float32(0.5 * sky) + through * 0.2 * level_sun
    return LightArrays(
        sun=toward * np.float32(through > 0.0),
        sun_rgb=beam * np.float32(through),
        glow_direction=toward,
        glow_rgb=colours.glow * np.float32(behind / NOON_SKY) + np.float32(0.12) * beam * np.float32(through),
        zenith=colours.zenith * np.float32(behind / NOON_SKY)
        + np.float32(0.5) * glow_lux * _rgb(0.8, 0.9, 1.25),
        horizon=colours.horizon * np.float32(behind / NOON_SKY) + np.float32(1.6) * glow_lux,
        cloud_rgb=colours.cloud * np.float32(fall.cloud) + glow_lux,
        clouds=clouds,
        sky_rgb=colours.sky * np.float32(sky) + night,
        bounce_rgb=_rgb(0.168, 0.160, 0.145) * np.float32(white_lux / UNIT_LUX) + np.float32(0.6) * night,
        street_rgb=_rgb(0.19, 0.19, 0.183) * np.float32(white_lux / UNIT_LUX) + np.float32(0.3) * night,
        haze_rgb=veiled.astype(np.float32) + np.float32(1.5) * night,
        air=make_air(conditions),
        lamps=NO_LAMPS,
        lit_windows=0.35 if dark else 0.0,
        glow=2.5 * NOON_EXPOSURE / exposure,
        exposure=exposure,
    )


def street_lamps_on(conditions: Conditions) -> bool:
    """Return whether street lamps are on."""
    return daylight_lux(conditions) < LAMPS_BELOW_LUX


def headlights_on(conditions: Conditions) -> bool:
    """Return whether drivers have their lights on."""
    hidden = conditions.rain_mmph > 0.0 or conditions.visibility_m < HEADLIGHTS_BELOW_M
    return hidden or daylight_lux(conditions) < HEADLIGHTS_BELOW_LUX


class _SkyColours(NamedTuple):
    zenith: Rgb
    horizon: Rgb
    cloud: Rgb
    glow: Rgb
    sky: Rgb


def _sky_colours(elevation_deg: float, clouds: float) -> _SkyColours:
    """Return the colours of a sky with the brightness of noon: blue by day, warm with a low sun, grey under
    clouds.

    An overcast sky is three times as bright at the zenith as at the horizon (CIE standard overcast sky).
    """
    # 1 at the horizon, 0 at 18° and above; 1 for an overcast sky
    low = min(max(1.0 - elevation_deg / 18.0, 0.0), 1.0)
    grey = min(max((clouds - 0.45) / 0.5, 0.0), 1.0)

    def mix(day: Rgb, evening: Rgb, overcast: Rgb) -> Rgb:
        clear = (1.0 - low) * day + low * evening
        return ((1.0 - grey) * clear + grey * overcast).astype(np.float32)

    return _SkyColours(
        zenith=mix(_rgb(0.14, 0.28, 0.60), _rgb(0.20, 0.28, 0.52), _rgb(0.38, 0.40, 0.43)),
        horizon=mix(_rgb(0.62, 0.72, 0.83), _rgb(0.95, 0.62, 0.44), _rgb(0.25, 0.27, 0.29)),
        cloud=mix(_rgb(0.99, 1.00, 1.02), _rgb(1.12, 0.95, 0.92), _rgb(0.96, 1.00, 1.06)),
        glow=mix(_rgb(0.0, 0.0, 0.0), _rgb(2.2, 1.0, 0.35), _rgb(0.0, 0.0, 0.0)),
        sky=mix(_rgb(0.88, 1.00, 1.19), _rgb(0.98, 0.98, 1.08), _rgb(0.97, 1.00, 1.04)),
    )


def _sun_rgb(elevation_deg: float) -> Rgb:
    """Return the sunlight after its way through the air.

    The air mass is that of Kasten & Young (Applied Optics 28, 1989).
    """
    if elevation_deg < -0.5:
        return _rgb(0.0, 0.0, 0.0)
    height = max(elevation_deg, 0.0)
    # Beer-Lambert with the air mass of the elevation
    air_mass = 1.0 / (math.sin(math.radians(height)) + 0.50572 * (height + 6.07995) ** -1.6364)
    return (np.array(SUN_OUTSIDE_RGB) * np.exp(-air_mass * np.array(AIR_DEPTH_RGB))).astype(np.float32)


def _rgb(r: float, g: float, b: float) -> Rgb:
    return np.array([r, g, b], dtype=np.float32)
