"""Localization with the sensors that the leaderboard allows: satellite navigation, compass and speedometer.

No map is needed to read the satellite positions. The route is given both in world coordinates and in latitude
and longitude, related by a Mercator projection of unknown scale and origin. CARLA 0.9.16 projects differently
from the leaderboard's routes: 0.04 % larger, and with north and south exchanged. A reading may therefore mean
two places, and the one nearer to the expected position is taken.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from foredrive.errors import InputError

GAIN = 0.02
"""Share of the difference between satellites and dead reckoning that is corrected in one step of 0.05 s.
It balances satellites with an error of 0.56 m (the leaderboard's 5e-6 degrees) and dead reckoning with an
error of 1 cm per step."""
SPREAD_M = 1.0
"""A shorter route, m, does not determine the scale."""


@dataclass(frozen=True)
class GeoFrame:
    """Map from latitude φ and longitude λ to our world: x = a·λ + b, y = a·ln tan(45° + φ/2) + c.

    Latitude and longitude are given in degrees; the formula takes radians.
    """

    scale_m: float
    x_m: float
    y_m: float

    def xy(
        self, lat_deg: float, lon_deg: float, near_xy: Float64[np.ndarray, "2"]
    ) -> Float64[np.ndarray, "2"]:
        """Return the place in our world or its mirror image in y, m, whichever is nearer to `near_xy`."""
        east, north = _mercator(lat_deg, lon_deg)
        there = np.array([self.scale_m * east + self.x_m, self.scale_m * north + self.y_m])
        mirrored = there * [1.0, -1.0]
        is_nearer = np.hypot(*(mirrored - near_xy)) < np.hypot(*(there - near_xy))
        return mirrored if is_nearer else there


def fit_geo_frame(lat_lon_deg: Float64[np.ndarray, "N 2"], xy: Float64[np.ndarray, "N 2"]) -> GeoFrame:
    """Fit the frame to points that are known in both coordinate systems, by least squares.

    Raises:
        InputError: the points are at one place.
    """
    unit = np.array([_mercator(lat, lon) for lat, lon in lat_lon_deg.tolist()]).reshape(-1, 2)
    about = unit - unit.mean(axis=0), xy - xy.mean(axis=0)
    if np.linalg.norm(np.ptp(xy, axis=0)) < SPREAD_M:
        raise InputError(
            "the route's points coincide, so they cannot relate latitude and longitude to metres"
        )
    scale_m = float((about[0] * about[1]).sum() / (about[0] ** 2).sum())
    origin = xy.mean(axis=0) - scale_m * unit.mean(axis=0)
    return GeoFrame(scale_m, float(origin[0]), float(origin[1]))


@dataclass(frozen=True)
class PoseEstimate:
    """Estimated pose of the rear axle in our world."""

    x_m: float
    y_m: float
    yaw_rad: float
    t_s: float
    steps: int = 1
    """Number of measurements in the estimate."""

    @property
    def T_world_ego(self) -> Float64[np.ndarray, "4 4"]:
        """Return the pose on flat ground: satellite heights are no better than half a metre."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        T = np.eye(4)
        T[:2, :2] = [[cos, -sin], [sin, cos]]
        T[:2, 3] = self.x_m, self.y_m
        return T


def locate(
    before: PoseEstimate | None,
    satellites_xy: Float64[np.ndarray, "2"],
    yaw_rad: float,
    speed_mps: float,
    t_s: float,
) -> PoseEstimate:
    """Return the estimate one step later: dead reckoning, corrected towards the satellites.

    Args:
        yaw_rad: heading by the compass. If it is not finite, as CARLA's is at times, the last heading is
            kept.
    """
    if before is None:
        x, y = satellites_xy.tolist()
        return PoseEstimate(x, y, yaw_rad if math.isfinite(yaw_rad) else 0.0, t_s)
    yaw_rad = yaw_rad if math.isfinite(yaw_rad) else before.yaw_rad
    way_m = speed_mps * (t_s - before.t_s)
    along = before.yaw_rad + 0.5 * math.remainder(yaw_rad - before.yaw_rad, 2 * math.pi)
    gone = np.array([before.x_m, before.y_m]) + way_m * np.array([math.cos(along), math.sin(along)])
    steps = before.steps + 1
    x, y = gone + max(GAIN, 1 / steps) * (satellites_xy - gone)
    return dataclasses.replace(before, x_m=float(x), y_m=float(y), yaw_rad=yaw_rad, t_s=t_s, steps=steps)


def lat_lon_of(plan: Sequence[tuple[dict[str, float], object]]) -> Float64[np.ndarray, "N 2"]:
    """Return latitudes and longitudes of the leaderboard's route, degrees."""
    return np.array([(point["lat"], point["lon"]) for point, _ in plan], dtype=float).reshape(-1, 2)


def _mercator(lat_deg: float, lon_deg: float) -> tuple[float, float]:
    return math.radians(lon_deg), math.log(math.tan(0.25 * math.pi + 0.5 * math.radians(lat_deg)))
