"""Set-up of a drive along a route through a town, for every simulator with towns."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from foredrive.scene.conditions import BackgroundTraffic, Conditions
from foredrive.sensors.vehicle import VehicleSensors

SETTLE_S = 3.0
"""Time before a drive, s, in which the traffic leaves its unlikely initial state. The ego vehicle stands
until then."""


@dataclass(frozen=True, eq=False)
class RouteScenario:
    """Route and conditions of a drive. The vehicle starts from rest at the route's beginning."""

    town: str
    route_xyz: Float64[np.ndarray, "M 3"]
    """Route along the lanes, m, world frame."""
    seed: int = 0
    """Seed of the place, the traffic and all noise."""
    background_traffic: BackgroundTraffic = field(default_factory=BackgroundTraffic)
    conditions: Conditions | None = None
    """If None, bright daylight is drawn from the seed."""
    sensors: VehicleSensors | None = None
    """If None, key frames have only boxes."""
    past_frames: int = 1
    """Number of key frames before now in an observation."""
    limit_s: float = np.inf
    """The drive ends after this time, s."""
