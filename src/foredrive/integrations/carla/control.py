"""Converts the controller's commands into CARLA's pedals and steering.

CARLA's vehicles have an engine, gears and tyres, and the acceleration of a pedal depends on all of them. The
pedals therefore follow a simple model of the vehicle, plus a correction for the speed that the vehicle lags
behind its commands. The model's constants are estimates and have not been calibrated on a server. The
correction makes up for errors of ±3 m/s².
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from foredrive.driving.dynamics import EGO, STEP_S
from foredrive.scene import Control

FULL_THROTTLE_MPS2 = 4.0
"""Estimate for the ego vehicle in its lower gears, m/s²."""
FULL_BRAKE_MPS2 = 8.0
"""On a dry road, m/s²."""
COASTING_MPS2, COASTING_PER_M = 0.3, 8e-4
"""Deceleration without pedals, by tyres and air: the first, m/s², plus the second, 1/m, times the speed
squared."""
CATCH_UP_PER_S = 2.0
"""Additional acceleration per m/s that the speed lags behind, 1/s."""
MAX_BEHIND_MPS = 1.5
CURVATURE_AT_LOCK_PER_M = 0.278
"""Curvature at full steering, 1/m; smaller steering gives proportionally less. It is the slope of the
bicycle model that Chen et al. ("Learning to drive from a world on rails", ICCV 2021) fitted to CARLA's
Lincoln, 0.368 rad / 1.327 m. The wheels can turn further (70°), but they turn less at higher speed, and
tyres slip."""
STANDING_MPS = 0.1


class Pedals(NamedTuple):
    """The fields of a `carla.VehicleControl`."""

    throttle: float
    brake: float
    steer: float
    """-1 to 1, positive to the right."""


@dataclass(frozen=True)
class CommandedSpeed:
    """Effect of all commands so far."""

    speed_mps: float | None = None
    """Speed that the vehicle would have now if it had followed its commands, m/s. None at the beginning."""


def actuate(control: Control, speed_mps: float, commanded: CommandedSpeed) -> tuple[Pedals, CommandedSpeed]:
    """Return pedals and steering for the step that begins now, and the state for the next step."""
    wanted = min(max(control.acceleration_mps2, -EGO.max_braking_mps2), EGO.max_acceleration_mps2)
    behind = 0.0 if commanded.speed_mps is None else commanded.speed_mps - speed_mps
    behind = min(max(behind, -MAX_BEHIND_MPS), MAX_BEHIND_MPS)
    stands = speed_mps < STANDING_MPS
    if stands and wanted <= 0:  # standing as commanded
        behind, due = 0.0, speed_mps
    else:
        due = speed_mps + behind + wanted * STEP_S
    coasting = 0.0 if stands else COASTING_MPS2 + COASTING_PER_M * speed_mps**2
    force = wanted + CATCH_UP_PER_S * behind + coasting
    throttle, brake = max(force, 0.0) / FULL_THROTTLE_MPS2, max(-force, 0.0) / FULL_BRAKE_MPS2
    return Pedals(min(throttle, 1.0), min(brake, 1.0), steer_of(control.steering_rad)), CommandedSpeed(due)


def steer_of(steering_rad: float) -> float:
    """Return CARLA's steering for a front-wheel angle of our bicycle model: the same curvature, mirrored."""
    curvature = (
        math.tan(min(max(steering_rad, -EGO.max_steering_rad), EGO.max_steering_rad)) / EGO.wheelbase_m
    )
    return min(max(-curvature / CURVATURE_AT_LOCK_PER_M, -1.0), 1.0)


def steering_rad_of(steer: float) -> float:
    """Return the front-wheel angle of our bicycle model that corresponds to CARLA's steering, rad."""
    return math.atan(-steer * CURVATURE_AT_LOCK_PER_M * EGO.wheelbase_m)
