"""From what our controller asks for to CARLA's pedals and steering wheel.

CARLA's vehicles have an engine, gears and tyres; how much acceleration a pedal gives depends on all of them.
So the pedals are what a simple model of the vehicle says, corrected by how far the speed has fallen behind
what was asked for. The model's constants are estimates, nobody has calibrated them on a server: the
correction makes up for ±3 m/s² of error.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from foredrive.scene import Control
from foredrive.simulation.dynamics import EGO, STEP_S

FULL_THROTTLE_MPS2 = 4.0
"""Estimate for the ego vehicle in its lower gears."""
FULL_BRAKE_MPS2 = 8.0
"""On a dry road."""
COASTING_MPS2, COASTING_PER_M = 0.3, 8e-4
"""Without pedals it slows down by this, and by this times the square of the speed: tyres and air."""
CATCH_UP_PER_S = 2.0
"""Acceleration for each m/s that the speed is behind."""
MOST_BEHIND_MPS = 1.5
CURVATURE_AT_LOCK_PER_M = 0.278
"""How sharply the vehicle turns at full steering, in proportion below: the slope of the bicycle that Chen et
al. ("Learning to drive from a world on rails", ICCV 2021) fitted to CARLA's Lincoln, 0.368 rad / 1.327 m.
The wheels can turn further than that (70°), but do so less the faster it goes, and tyres slip."""
STANDING_MPS = 0.1


class Pedals(NamedTuple):
    """The fields of a `carla.VehicleControl`."""

    throttle: float
    brake: float
    steer: float
    """-1 to 1, positive to the right."""


@dataclass(frozen=True)
class Asked:
    """What has been asked for so far."""

    speed_mps: float | None = None
    """The speed that the vehicle would have by now if it had done as it was asked to; None at first."""


def actuate(control: Control, speed_mps: float, asked: Asked) -> tuple[Pedals, Asked]:
    """Pedals and steering for the step that begins now, and what to remember for the next one."""
    wanted = min(max(control.acceleration_mps2, -EGO.max_braking_mps2), EGO.max_acceleration_mps2)
    behind = 0.0 if asked.speed_mps is None else asked.speed_mps - speed_mps
    behind = min(max(behind, -MOST_BEHIND_MPS), MOST_BEHIND_MPS)
    stands = speed_mps < STANDING_MPS
    if stands and wanted <= 0:  # as it is to
        behind, due = 0.0, speed_mps
    else:
        due = speed_mps + behind + wanted * STEP_S
    coasting = 0.0 if stands else COASTING_MPS2 + COASTING_PER_M * speed_mps**2
    force = wanted + CATCH_UP_PER_S * behind + coasting
    throttle, brake = max(force, 0.0) / FULL_THROTTLE_MPS2, max(-force, 0.0) / FULL_BRAKE_MPS2
    return Pedals(min(throttle, 1.0), min(brake, 1.0), steer_of(control.steering_rad)), Asked(due)


def steer_of(steering_rad: float) -> float:
    """CARLA's steering for a front-wheel angle of our bicycle: the same curvature, mirrored."""
    curvature = (
        math.tan(min(max(steering_rad, -EGO.max_steering_rad), EGO.max_steering_rad)) / EGO.wheelbase_m
    )
    return min(max(-curvature / CURVATURE_AT_LOCK_PER_M, -1.0), 1.0)


def steering_rad_of(steer: float) -> float:
    """The front-wheel angle of our bicycle that CARLA's steering amounts to."""
    return math.atan(-steer * CURVATURE_AT_LOCK_PER_M * EGO.wheelbase_m)
