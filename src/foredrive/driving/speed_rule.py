"""The rule that drives along a given path: how fast, by what is on the path now and in the next seconds.

The intelligent driver model follows the vehicle ahead and stops at the light. Where its progress would meet a
road user who crosses, cuts in or comes towards the vehicle, the fastest of a few slower profiles that meets
nobody takes its place. The rule is the ceiling of planners on the same path, and labels what they learn.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from foredrive.data.truth.affordances import PathAhead
from foredrive.driving.car_following import follow_acceleration, free_acceleration
from foredrive.driving.dynamics import EGO
from foredrive.driving.lane_rules import TAIL
from foredrive.driving.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.geometry.polylines import points_at
from foredrive.scene.affordances import CELL_M, CELLS, LATER_DT_S, TIMES
from foredrive.scene.traffic_light import LightState

DESIRED_MPS, ACCELERATION_MPS2, BRAKING_MPS2 = 8.0, 1.5, 2.5
STANDSTILL_M, TIME_GAP_S = 2.0, 1.2
"""Parameters of the model: a calm driver in town."""
MAX_BRAKING_MPS2 = 8.0
LATERAL_MPS2 = 2.0
"""Bound of the lateral acceleration; it slows the vehicle before curves."""
LOOKS_M = 20.0
STEPS_PER_FRAME = 5
FRONT_M = EGO.axle_to_centre_m + 0.5 * EGO.length_m
"""Distance from the rear axle to the front bumper."""
TAIL_M = FRONT_M - EGO.axle_to_centre_m + TAIL * 0.5 * EGO.length_m
"""Distance from the front bumper back to the point that must not cross the line at red (`lane_rules`)."""
YELLOW_BRAKING_MPS2, LATE_BRAKING_MPS2 = 3.0, 7.0
"""A yellow light stops the vehicle if it has to brake at most as hard as the first, a red one as the last."""
SLOWER = ((6.0, 1.5), (4.0, 2.0), (2.5, 2.5), (0.0, 2.0), (0.0, 3.5), (0.0, 6.0))
"""Speeds, m/s, and the braking down to them, m/s²: profiles for where a road user is in the way."""
MARGIN_M = 1.5
"""Least distance from the front bumper to a road user who is met, m."""
REJOINS_M = 8.0
"""Distance over which a vehicle beside its path comes back to it."""
STANDS_MPS = 0.2
"""A vehicle that is slower does not drive into anybody."""


class Obstacle(NamedTuple):
    """Something to follow or to stop at."""

    gap_m: float
    """Distance from the front bumper along the path."""
    speed_mps: float


class PathView(NamedTuple):
    """All that decides about the speed on a path."""

    light: LightState
    light_m: float
    """Distance of the stop line from the front bumper; negative beyond it."""
    lead: Obstacle | None
    occupied: Bool[np.ndarray, "T G"]
    """As in `Affordances`."""


def rule_progress(path: PathAhead, speed_mps: float, view: PathView) -> Float64[np.ndarray, "S"]:
    """Return the distance along the path at each waypoint of a plan, m."""
    # A light that stops is a standing obstacle at its line
    obstacles = [] if view.lead is None else [view.lead]
    if must_stop(view.light, view.light_m, speed_mps):
        obstacles.append(Obstacle(_stop_m(view.light_m), 0.0))
    # What it would do behind the vehicle ahead and for the light alone.
    nominal_m = drive_along(path, speed_mps, obstacles)
    t_s = FRAME_DT_S * np.arange(1, HORIZON_STEPS + 1)
    later_s = LATER_DT_S * np.arange(1, TIMES)
    followed_m = _prolonged(nominal_m, t_s, later_s)
    if not meets_somebody(followed_m, view.occupied):
        return nominal_m
    # Somebody comes into its way: the fastest slower profile that meets nobody, at last full braking.
    for target_mps, braking_mps2 in SLOWER:
        # Only profiles that slow down; the last ones brake to a halt
        if target_mps == 0 or target_mps < max(speed_mps, 1.0):
            slower_m = np.minimum(slowed_m(speed_mps, target_mps, braking_mps2, later_s), followed_m)
            if not meets_somebody(slower_m, view.occupied):
                return np.minimum(slowed_m(speed_mps, target_mps, braking_mps2, t_s), nominal_m)
    return np.minimum(slowed_m(speed_mps, 0.0, MAX_BRAKING_MPS2, t_s), nominal_m)


def must_stop(light: LightState, light_m: float, speed_mps: float) -> bool:
    """Return whether the vehicle has to stop for a light, and can.

    Beyond the line, it stops as long as its tail has not crossed, because that is what counts.
    """
    room_m = max(light_m, 0.0) + (TAIL_M if light_m < 0 else 0.0)
    # Deceleration needed to stop in the room that is left
    needed_mps2 = speed_mps**2 / (2 * max(room_m, 0.1))
    if light is LightState.RED:
        return light_m > -TAIL_M and needed_mps2 < LATE_BRAKING_MPS2
    return light is LightState.YELLOW and light_m > 0 and needed_mps2 < YELLOW_BRAKING_MPS2


def _stop_m(light_m: float) -> float:
    """Return the gap to the obstacle that stands for a line: the model stops `STANDSTILL_M` before it."""
    return light_m + 1.0 if light_m > 0 else STANDSTILL_M


def meets_somebody(along_m: Float64[np.ndarray, "T"], occupied: Bool[np.ndarray, "_ G"]) -> bool:
    """Return whether progress at the times after now meets a road user in the path.

    Args:
        along_m: distance along the path at each time.
        occupied: cells at now and at these times.
    """
    # Cells that the vehicle's body and a margin in front of it cover at each time
    moving = np.diff(along_m, prepend=0.0) / LATER_DT_S > STANDS_MPS
    start_m = CELL_M * np.arange(CELLS)
    front_m = along_m[:, None] + MARGIN_M
    ego_cells = (start_m < front_m) & (start_m + CELL_M > front_m - MARGIN_M - EGO.length_m)
    return bool((ego_cells & occupied[1:] & moving[:, None]).any())


def slowed_m(
    speed_mps: float, target_mps: float, braking_mps2: float, t_s: Float64[np.ndarray, "T"]
) -> Float64[np.ndarray, "T"]:
    """Return the distance driven at some times while the speed falls to a target and stays there."""
    # Brake at a constant rate, then keep the target speed
    braked_s = np.minimum(t_s, max(speed_mps - target_mps, 0.0) / braking_mps2)
    distance_m: Float64[np.ndarray, T] = (
        speed_mps * braked_s - 0.5 * braking_mps2 * braked_s**2 + target_mps * (t_s - braked_s)
    )
    return distance_m


def _prolonged(
    along_m: Float64[np.ndarray, "S"], t_s: Float64[np.ndarray, "S"], later_s: Float64[np.ndarray, "T"]
) -> Float64[np.ndarray, "T"]:
    """Return progress at other times; beyond its end it goes on at its last speed."""
    last_mps = (along_m[-1] - along_m[-2]) / FRAME_DT_S
    within = np.interp(later_s, np.append(0.0, t_s), np.append(0.0, along_m))
    return np.asarray(within + last_mps * np.maximum(later_s - t_s[-1], 0.0))


def drive_along(path: PathAhead, speed_mps: float, obstacles: list[Obstacle]) -> Float64[np.ndarray, "S"]:
    """Return the distance along the path at each waypoint, by the IDM behind the nearest of all obstacles."""
    dt_s = FRAME_DT_S / STEPS_PER_FRAME
    desired = np.array([curve_speed(path)])
    limits = (np.array([ACCELERATION_MPS2]), np.array([BRAKING_MPS2]))
    along_m, speed, waypoints = 0.0, speed_mps, []
    for step in range(HORIZON_STEPS * STEPS_PER_FRAME):
        v = np.array([speed])
        # IDM behind each obstacle; the strictest one counts
        free = free_acceleration(v, desired, *limits)
        wanted = float(free[0])
        for obstacle in obstacles:
            gap = obstacle.gap_m + obstacle.speed_mps * step * dt_s - along_m
            behind = follow_acceleration(
                free,
                v,
                v - obstacle.speed_mps,
                np.array([gap]),
                np.array([STANDSTILL_M]),
                np.array([TIME_GAP_S]),
                *limits,
            )
            wanted = min(wanted, float(behind[0]))
        # Speeds do not become negative; distance by the mean speed
        after = max(0.0, speed + max(wanted, -MAX_BRAKING_MPS2) * dt_s)
        along_m, speed = along_m + 0.5 * (speed + after) * dt_s, after
        if (step + 1) % STEPS_PER_FRAME == 0:
            waypoints.append(along_m)
    return np.array(waypoints)


def curve_speed(path: PathAhead) -> float:
    """Return the speed at which the lateral acceleration of the next metres is bearable."""
    count = min(int(path.valid.sum()), int(LOOKS_M))
    if count < 8:
        return DESIRED_MPS
    # Heading over 4 m, and its largest change per metre: the curvature
    xy = path.xy[:count].numpy()
    heading = np.unwrap(np.arctan2(*(xy[4:] - xy[:-4]).T[::-1]))
    bend = float(np.abs(np.diff(heading)).max()) if len(heading) > 1 else 0.0
    return float(min(DESIRED_MPS, np.sqrt(LATERAL_MPS2 / max(bend, 1e-6))))


def waypoints_along(path: PathAhead, along_m: Float64[np.ndarray, "S"]) -> Float64[np.ndarray, "S 2"]:
    """Return points of the path, which the vehicle rejoins over `REJOINS_M`."""
    xy = path.xy[path.valid].double().numpy()
    if len(xy) < 2:
        return np.zeros((len(along_m), 2))
    points = points_at(xy, np.arange(len(xy), dtype=np.float64), along_m)
    # The lateral offset decays along the path
    return np.asarray(points - np.exp(-along_m / REJOINS_M)[:, None] * xy[0])
