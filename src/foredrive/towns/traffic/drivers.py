"""Drivers: the situation ahead of them, their accelerations, and the motion of their vehicles."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.driving.car_following import (
    CRAWL_MPS,
    EMERGENCY_MPS2,
    JERK_DOWN_MPS3,
    JERK_EMERGENCY_MPS3,
    JERK_UP_MPS3,
    MAX_BRAKING_MPS2,
    SOFT_STOP_S,
    follow_acceleration,
    free_acceleration,
)
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.leaders import STANDSTILL_M, Leaders
from foredrive.towns.traffic.vehicles import Vehicles, desired_speed

LINE_STANDSTILL_M = 1.0


class DrivingContext(NamedTuple):
    """The situation ahead of N drivers."""

    free_mps2: Float64[np.ndarray, "N"]
    """Acceleration on an open road, m/s²."""
    leaders: Leaders
    halt_mps2: Float64[np.ndarray, "N"]
    """Acceleration for stop lines and crossings alone, m/s²."""

    def desired_mps2(self, vehicles: Vehicles) -> Float64[np.ndarray, "N"]:
        """Return the acceleration that the drivers want, m/s²."""
        # A follower brakes for the vehicle that demands most, which may not be the nearest
        every, limiting = np.arange(len(self.free_mps2)), self.leaders.limiting
        gap_m = self.leaders.limiting_gap_m
        following = following_acceleration(vehicles, every, self.free_mps2, limiting, gap_m)
        return np.minimum(following, self.halt_mps2)


class Decision(NamedTuple):
    """The decisions of N drivers."""

    right_of_way: dict[str, np.ndarray]
    """New values of `granted`, `requested_s`, `rank` and `has_stopped`."""
    desired_mps2: Float64[np.ndarray, "N"]
    context: DrivingContext

    def where(self, mask: Bool[np.ndarray, "N"], other: "Decision") -> "Decision":
        """Return the decisions, with those of the drivers in `mask` taken from `other`; the context stays."""
        values = {
            name: np.where(mask, other.right_of_way[name], value) for name, value in self.right_of_way.items()
        }
        return Decision(values, np.where(mask, other.desired_mps2, self.desired_mps2), self.context)


def driving_context(
    graph: LaneGraph,
    vehicles: Vehicles,
    starts_m: Float64[np.ndarray, "N W"],
    leaders: Leaders,
    halt_gap_m: Float64[np.ndarray, "N"],
) -> DrivingContext:
    """Return the situation of drivers that have to stop after a distance (infinite: they need not stop)."""
    v = vehicles
    desired = desired_speed(graph, v, starts_m)
    free = free_acceleration(v.speed_mps, desired, v.accel_mps2, v.decel_mps2)
    # A line needs no time gap because it does not move.
    at_line = np.full(len(desired), LINE_STANDSTILL_M)
    # The line is a standing leader (closing speed = own speed) with a small time gap
    driver = (0.3 * v.time_gap_s, v.accel_mps2, v.decel_mps2)
    halt = follow_acceleration(free, v.speed_mps, v.speed_mps, halt_gap_m, at_line, *driver)
    return DrivingContext(free, leaders, halt)


def following_acceleration(
    vehicles: Vehicles,
    rows: Int[np.ndarray, "N"],
    free_mps2: Float64[np.ndarray, "N"],
    leader: Int[np.ndarray, "N"],
    gap_m: Float64[np.ndarray, "N"],
) -> Float64[np.ndarray, "N"]:
    """Return the acceleration that the drivers `rows` would want behind `leader` (-1: none), m/s²."""
    v, speed = vehicles, vehicles.speed_mps[rows]
    # Without a leader the gap is infinite and the closing speed 0: IDM then gives the free acceleration
    closing = speed - np.where(leader >= 0, v.speed_mps[leader], speed)
    gap = np.where(leader >= 0, gap_m, np.inf)
    standstill = np.full(len(rows), STANDSTILL_M)
    driver = (v.time_gap_s[rows], v.accel_mps2[rows], v.decel_mps2[rows])
    return follow_acceleration(free_mps2, speed, closing, gap, standstill, *driver)


def move_vehicles(v: Vehicles, desired_mps2: Float64[np.ndarray, "N"], dt_s: float) -> Vehicles:
    """Change the speed as wanted and move by a ballistic update.

    The jerk is comfortable except in an emergency.
    """
    # Vehicles cannot brake or accelerate beyond their limits
    desired = np.clip(desired_mps2, -MAX_BRAKING_MPS2, v.accel_mps2)
    gentle = np.maximum(desired, -v.speed_mps / SOFT_STOP_S)  # no jolt at the end of a stop
    desired = np.where(desired < -EMERGENCY_MPS2, desired, gentle)
    # Limit the jerk: hard braking may build up faster than comfortable braking
    down = np.where(desired < -EMERGENCY_MPS2, JERK_EMERGENCY_MPS3, JERK_DOWN_MPS3)
    a = np.clip(desired, v.acceleration_mps2 - down * dt_s, v.acceleration_mps2 + JERK_UP_MPS3 * dt_s)
    # A vehicle that comes to rest within the step stops for good and does not roll backwards
    stops = (v.speed_mps + a * dt_s <= CRAWL_MPS) & (a <= 0)
    braking = np.minimum(a, -1e-9)
    # v² / (2 |a|) to standstill, at most the way of a whole step
    to_rest = np.minimum(-0.5 * v.speed_mps**2 / braking, v.speed_mps * dt_s)
    # Ballistic update: s += v dt + a dt² / 2
    distance = np.where(stops, to_rest, (v.speed_mps + 0.5 * a * dt_s) * dt_s)
    speed = np.where(stops, 0.0, v.speed_mps + a * dt_s)
    return dataclasses.replace(
        v.moved(np.where(v.active, distance, 0.0)),
        speed_mps=np.where(v.active, speed, 0.0),
        acceleration_mps2=np.where(v.active & ~stops, a, 0.0),
    )
