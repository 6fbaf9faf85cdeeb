"""Records of what a driver must see of its path: next light and stop sign, and road users over time."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.scene.record import Record

LIGHT_RANGE_M, LEAD_RANGE_M = 60.0, 50.0
"""Distances along the path up to which a light and a lead vehicle count, m."""
LATER_DT_S = 0.5
CELLS, CELL_M = 24, 2.0
"""Cells of the path ahead of the front bumper, and their length, m."""
TIMES = 9
"""Times of the occupancy of the path: now and every `LATER_DT_S` up to 4 s."""
HALF_WIDTH_M = 1.2
"""A road user is in the path if a part of it is at most this far beside it, m: half the ego vehicle and a
margin."""


@dataclass(frozen=True)
class Affordances(Record):
    """Ground truth of what decides about braking (the affordances of Sauer et al. 2018), at now.

    Distances are from the front bumper along the path: the route, or the driven path where the log has no
    route. Entries whose `known` is False, and padding, hold zeros.
    """

    path_xy: Float[Tensor, "*b R 2"]
    """Path from the point beside the rear axle on, one point a metre, ego frame, m."""
    path_valid: Bool[Tensor, "*b R"]
    light: Int[Tensor, "*b"]
    """`LightState` of the next light on the path; NONE if none is within `LIGHT_RANGE_M`."""
    light_m: Float[Tensor, "*b"]
    """Distance of its stop line. It is negative while the bumper is up to 4.4 m beyond the line."""
    light_known: Bool[Tensor, "*b"]
    lamp_xyz: Float[Tensor, "*b L 3"]
    """Places of the lamps of this light, ego frame, m."""
    lamp: Bool[Tensor, "*b L"]
    """False for padding."""
    lamps_known: Bool[Tensor, "*b"]
    sign: Bool[Tensor, "*b"]
    """True if a stop sign is on the path within `LIGHT_RANGE_M`."""
    sign_m: Float[Tensor, "*b"]
    """Distance of the stop line of the next one, as `light_m`."""
    sign_known: Bool[Tensor, "*b"]
    lead: Bool[Tensor, "*b"]
    """Whether a vehicle stands or drives in the path within `LEAD_RANGE_M`."""
    lead_m: Float[Tensor, "*b"]
    """Gap to the nearest one."""
    lead_mps: Float[Tensor, "*b"]
    """Its speed along the path. NaN where its box has no velocity."""
    lead_known: Bool[Tensor, "*b"]
    occupied: Bool[Tensor, "*b T G"]
    """Whether a road user is in each of `CELLS` of the path at each of `TIMES`, by the recorded futures."""
    occupied_known: Bool[Tensor, "*b T G"]
    """False beyond the end of the route, at times without annotation, and where all road users of the cell
    are hidden now."""


@dataclass(frozen=True)
class PathEstimate(Record):
    """The prediction for the path: its next light, and the road users in it over time."""

    light: Float[Tensor, "*b 4"]
    """Probability of each `LightState`."""
    light_m: Float[Tensor, "*b"]
    """Distance of its stop line, m."""
    occupied: Float[Tensor, "*b T G"]
    """Probability that a cell of the path is occupied at a time, as in `Affordances`."""
