"""Drivers: the situation ahead of them, their accelerations, and the motion of their vehicles."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.towns.traffic.car_following import (
    CRAWL_MPS,
    EMERGENCY_MPS2,
    HARDEST_BRAKING_MPS2,
    JERK_DOWN_MPS3,
    JERK_EMERGENCY_MPS3,
    JERK_UP_MPS3,
    SOFT_STOP_S,
    follow_acceleration,
    free_acceleration,
)
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.leaders import STANDSTILL_M, Ahead
from foredrive.towns.traffic.vehicles import Vehicles, speed_to_drive

LINE_STANDSTILL_M = 1.0


class Situation(NamedTuple):
    """The situation ahead of N drivers."""

    free_mps2: Float64[np.ndarray, "N"]
    """Acceleration on an open road, m/s²."""
    ahead: Ahead
    halt_mps2: Float64[np.ndarray, "N"]
    """Acceleration for stop lines and crossings alone, m/s²."""

    def wanted_mps2(self, vehicles: Vehicles) -> Float64[np.ndarray, "N"]:
        """Return the acceleration that the drivers want, m/s²."""
        every, ahead = np.arange(len(self.free_mps2)), self.ahead
        following = behind(vehicles, every, self.free_mps2, ahead.limiting, ahead.limiting_gap_m)
        return np.minimum(following, self.halt_mps2)


class Choice(NamedTuple):
    """The decisions of N drivers."""

    standing: dict[str, np.ndarray]
    """New values of `granted`, `asked_s`, `rank` and `has_stopped`."""
    wanted_mps2: Float64[np.ndarray, "N"]
    situation: Situation

    def where(self, who: Bool[np.ndarray, "N"], other: "Choice") -> "Choice":
        """Return the choice with the decisions of the drivers `who` taken from `other`.

        The situation does not change.
        """
        standing = {name: np.where(who, other.standing[name], value) for name, value in self.standing.items()}
        return Choice(standing, np.where(who, other.wanted_mps2, self.wanted_mps2), self.situation)


def see_ahead(
    graph: LaneGraph,
    vehicles: Vehicles,
    starts_m: Float64[np.ndarray, "N W"],
    ahead: Ahead,
    halt_gap_m: Float64[np.ndarray, "N"],
) -> Situation:
    """Return the situation of drivers that have to stop after a distance (infinite: they need not stop)."""
    v = vehicles
    wanted = speed_to_drive(graph, v, starts_m)
    free = free_acceleration(v.speed_mps, wanted, v.accel_mps2, v.decel_mps2)
    # A line needs no time gap because it does not move.
    at_line = np.full(len(wanted), LINE_STANDSTILL_M)
    driver = (0.3 * v.time_gap_s, v.accel_mps2, v.decel_mps2)
    halt = follow_acceleration(free, v.speed_mps, v.speed_mps, halt_gap_m, at_line, *driver)
    return Situation(free, ahead, halt)


def behind(
    vehicles: Vehicles,
    who: Int[np.ndarray, "N"],
    free_mps2: Float64[np.ndarray, "N"],
    leader: Int[np.ndarray, "N"],
    gap_m: Float64[np.ndarray, "N"],
) -> Float64[np.ndarray, "N"]:
    """Return the acceleration that the drivers `who` would want behind `leader` (-1: none), m/s²."""
    v, speed = vehicles, vehicles.speed_mps[who]
    closing = speed - np.where(leader >= 0, v.speed_mps[leader], speed)
    gap = np.where(leader >= 0, gap_m, np.inf)
    standstill = np.full(len(who), STANDSTILL_M)
    driver = (v.time_gap_s[who], v.accel_mps2[who], v.decel_mps2[who])
    return follow_acceleration(free_mps2, speed, closing, gap, standstill, *driver)


def drive(v: Vehicles, wanted_mps2: Float64[np.ndarray, "N"], dt_s: float) -> Vehicles:
    """Change the speed as wanted and move by a ballistic update.

    The jerk is comfortable except in an emergency.
    """
    wanted = np.clip(wanted_mps2, -HARDEST_BRAKING_MPS2, v.accel_mps2)
    gentle = np.maximum(wanted, -v.speed_mps / SOFT_STOP_S)  # no jolt at the end of a stop
    wanted = np.where(wanted < -EMERGENCY_MPS2, wanted, gentle)
    down = np.where(wanted < -EMERGENCY_MPS2, JERK_EMERGENCY_MPS3, JERK_DOWN_MPS3)
    a = np.clip(wanted, v.acceleration_mps2 - down * dt_s, v.acceleration_mps2 + JERK_UP_MPS3 * dt_s)
    stops = (v.speed_mps + a * dt_s <= CRAWL_MPS) & (a <= 0)
    braking = np.minimum(a, -1e-9)
    to_rest = np.minimum(-0.5 * v.speed_mps**2 / braking, v.speed_mps * dt_s)
    distance = np.where(stops, to_rest, (v.speed_mps + 0.5 * a * dt_s) * dt_s)
    speed = np.where(stops, 0.0, v.speed_mps + a * dt_s)
    return dataclasses.replace(
        v.moved(np.where(v.active, distance, 0.0)),
        speed_mps=np.where(v.active, speed, 0.0),
        acceleration_mps2=np.where(v.active & ~stops, a, 0.0),
    )
