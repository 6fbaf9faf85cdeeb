"""The lanes and stop lines of an embedded town, checked with the rules of `lane_rules`."""

import dataclasses

import numpy as np
from jaxtyping import Float64, Int

from foredrive.driving.lane_rules import (
    LINE_MARGIN_M,
    OUTSIDE_BY_M,
    WRONG_WAY_RAD,
    RuleState,
    StopLines,
    body_middle,
    lines_run,
    way_driven,
)
from foredrive.scene import BicycleState, Event
from foredrive.towns.map.town_map import StopZoneKind, TownMap
from foredrive.towns.traffic.lane_index import LaneIndex
from foredrive.towns.traffic.traffic import Traffic

LANES_WITHIN_M = 6.0


def stop_lines(town: TownMap) -> StopLines:
    """Return the stop lines at lights and at stop signs."""
    lanes = {lane.lane_id: lane for lane in town.lanes}
    kinds = (StopZoneKind.TRAFFIC_LIGHT, StopZoneKind.STOP_SIGN)
    rows = [
        (index, zone.kind is StopZoneKind.STOP_SIGN, lanes[name])
        for index, zone in enumerate(town.stop_zones)
        for name in zone.lane_ids
        if zone.kind in kinds and name in lanes
    ]
    # The stop line lies at the start of the guarded lane, across its direction
    starts = np.array([lane.centreline_xyz[:2] for *_, lane in rows]).reshape(-1, 2, 3)
    ahead = starts[:, 1, :2] - starts[:, 0, :2]
    return StopLines(
        zone=np.array([zone for zone, *_ in rows], dtype=np.int64),
        is_sign=np.array([sign for _, sign, _ in rows], dtype=np.bool_),
        xyz=starts[:, 0],
        ahead=ahead / np.linalg.norm(ahead, axis=1, keepdims=True),
        half_width_m=0.5 * np.array([lane.width_m for *_, lane in rows]) + LINE_MARGIN_M,
    )


class TownLaneRules:
    """Checks the rules for one drive in a town."""

    def __init__(self, town: TownMap, traffic: Traffic) -> None:
        self._lines = stop_lines(town)
        self._near: LaneIndex = traffic.lane_index
        self._graph = traffic.lanes

    def check(
        self,
        before: BicycleState,
        after: BicycleState,
        z_m: float,
        lights: Int[np.ndarray, "Z"],
        state: RuleState,
        t_s: float,
    ) -> tuple[list[Event], RuleState]:
        """Return the events of one step and the updated rule state.

        Args:
            lights: a `LightState` for each of the town's stop zones.
        """
        events, stopped_at = lines_run(self._lines, before, after, z_m, lights, state.stopped_at, t_s)
        outside = self._is_outside(np.append(body_middle(after), z_m), after.yaw_rad)
        more, state = way_driven(state, before, after, outside, t_s)
        return events + more, dataclasses.replace(state, stopped_at=stopped_at)

    def _is_outside(self, xyz: Float64[np.ndarray, "3"], yaw_rad: float) -> bool:
        samples = self._near.within(xyz, LANES_WITHIN_M)
        if not len(samples):
            return True
        # Distance beyond the border of the nearest lane decides whether the vehicle is off the road
        lane = self._near.lane[samples]
        away_m = np.hypot(*(self._near.xyz[samples, :2] - xyz[:2]).T)
        if (away_m - 0.5 * self._graph.width_m[lane]).min() > OUTSIDE_BY_M:
            return True
        inside = away_m < 0.5 * self._graph.width_m[lane]
        if not inside.any() or (self._graph.junction[lane[inside]] >= 0).any():
            return False  # between lanes, or in a junction, where lanes cross
        # Wrong way only if it faces against all lanes that it is on
        turned = np.abs((yaw_rad - self._near.heading[samples[inside]] + np.pi) % (2 * np.pi) - np.pi)
        return bool((turned > WRONG_WAY_RAD).all())
