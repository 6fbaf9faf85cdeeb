"""Traffic on a town's lanes and walkways, as a pure function from one state to the next."""

import dataclasses
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.scene import Category
from foredrive.scene.actors import ActorState
from foredrive.scene.traffic_light import LightState
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.traffic.appearance import people_actors, stray_actor, vehicle_actors
from foredrive.towns.traffic.driven import AT_LINE_M, Driven, SeenDriven, see_driven, stray_shadows
from foredrive.towns.traffic.drivers import Choice, Situation, drive, see_ahead
from foredrive.towns.traffic.fleet import LARGE_RADIUS_M, Starts, find_starts, is_large
from foredrive.towns.traffic.lane_changes import (
    HAS_TO_MPS2,
    LIKES_TO_MPS2,
    SETTLED_M,
    URGENT_S,
    begin_change,
    choose_change,
    find_stretches,
    let_in,
    room_to_change_m,
    who_may_change,
)
from foredrive.towns.traffic.lane_graph import LaneGraph, build_lane_graph, lanes_for
from foredrive.towns.traffic.leaders import find_leaders
from foredrive.towns.traffic.lights import SignalPlan, plan_signals
from foredrive.towns.traffic.near_lanes import NearLanes, near_lanes_of
from foredrive.towns.traffic.orders import Orders
from foredrive.towns.traffic.paths import extend_paths
from foredrive.towns.traffic.pedestrians import crossing_gap, empty_pavement, step_pedestrians
from foredrive.towns.traffic.right_of_way import claim_junctions
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.strays import moved_strays
from foredrive.towns.traffic.turnover import Turnover
from foredrive.towns.traffic.vehicles import (
    BEHIND,
    Poses,
    Vehicles,
    empty_slots,
    motion,
    path_starts,
    vehicle_poses,
)
from foredrive.towns.traffic.walkways import WalkGraph, build_walk_graph

HALT_MPS = 0.4
"""Speed below which a vehicle near a line waits there, m/s. A faster vehicle is still approaching."""
STOPPED_MPS = 0.1
"""Speed below which a vehicle counts as stopped at a stop sign, m/s, as in the rules of leaderboards."""
LACKS_ROOM_M = 1.0
"""Minimum distance in which vehicle 0 can still begin a lane change, m. With less, it has no room for the
change."""


class Traffic:
    """The rules of traffic in one town. `step` is a pure function of the state.

    Vehicle 0 is the centre of the simulated region: traffic appears and disappears out of its sight. It
    drives by the same rules as the others, or it is driven from outside.

    Args:
        town: the map.
        seed: the seed of everything random.
        vehicle_count: vehicles on the road at one time, vehicle 0 included.
        people_count: people on foot at one time, where the town has walkways.
        guest_count: additional slots, after those of the vehicles, for vehicles that the caller adds.
    """

    def __init__(
        self, town: TownMap, seed: int, vehicle_count: int, people_count: int, guest_count: int = 0
    ) -> None:
        self.seed = seed
        self.lanes: LaneGraph = build_lane_graph(town)
        self.walks: WalkGraph = build_walk_graph(town, self.lanes)
        self.signals: SignalPlan = plan_signals(self.lanes, np.random.default_rng((seed, 0)))
        self.starts: Starts = find_starts(self.lanes)
        self._zone_count = len(town.stop_zones)
        self._stretches = find_stretches(self.lanes)
        self._for_large = lanes_for(self.lanes, LARGE_RADIUS_M)
        self._slot_count = vehicle_count + guest_count
        self.guest_slots = range(vehicle_count, self._slot_count)
        self._people_count = people_count if len(self.walks.length_m) else 0
        self._turnover = Turnover(self.lanes, self.walks, self.starts, self._for_large, vehicle_count)

    @cached_property
    def near_lanes(self) -> NearLanes:
        """Return the town's lanes, searchable by position."""
        return near_lanes_of(self.lanes)

    def start(self, ego: Vehicles | None = None, route: Int[np.ndarray, "R"] | None = None) -> TrafficState:
        """Return the initial state, with vehicles and people placed.

        Args:
            ego: a placed vehicle that becomes vehicle 0. Without one, traffic fills the whole town.
            route: the lane in which vehicle 0 has to be at the end of each stretch, from its current stretch
                on. After the last one it takes random turns.
        """
        rng = np.random.default_rng((self.seed, 1))
        lanes = np.zeros(0, dtype=np.int64) if route is None else route
        state = TrafficState(
            time_s=0.0,
            step_index=0,
            vehicles=empty_slots(self._slot_count),
            people=empty_pavement(self._people_count),
            next_track_id=1,
            route=lanes,
            route_passed=0,
        )
        if ego is not None:
            vehicles = state.vehicles.replace_rows(np.array([0]), ego)
            state = dataclasses.replace(state, vehicles=vehicles, route=lanes if len(lanes) else ego.lane)
            state = self._know_path(state, rng)
        return self._turnover.fill(state, rng)

    def step(
        self, state: TrafficState, dt_s: float, ego: Driven | None = None, orders: Orders | None = None
    ) -> TrafficState:
        """Return the state one time step later. Equal arguments give equal results.

        Args:
            ego: the pose and motion of vehicle 0 at the time of `state` if it is driven from outside, on the
                road or off it. All others react to it, and its motion is not decided here. None: it drives by
                the same rules as the others.
            orders: orders for some of the other road users. None: no orders, and strays stand still.
        """
        rng = np.random.default_rng((self.seed, 2, state.step_index))
        driven = None if ego is None else self._see_driven(state, ego)
        may_ask = None if driven is None else driven.may_ask
        if driven is not None:
            route_passed = driven.route_passed
            state = dataclasses.replace(state, vehicles=driven.everyone, route_passed=route_passed)
        known = len(state.vehicles.active)
        if state.strays:
            shadows = stray_shadows(self.lanes, self.near_lanes, state.strays)
            state = dataclasses.replace(state, vehicles=state.vehicles.and_more(shadows))
            if may_ask is not None:
                may_ask = np.pad(may_ask, (0, len(shadows.active)), constant_values=True)
        starts_m = path_starts(self.lanes, state.vehicles.path)
        orders = (orders or Orders.none(self._slot_count)).padded(len(state.vehicles.active))
        light = self.signals.shows(state.time_s)
        choice = self._choose(state, starts_m, light, may_ask, orders.runs)
        if orders.blind.any():
            active = state.vehicles.active.copy()
            active[[0, *range(self._slot_count, known)]] = False
            unseen = dataclasses.replace(state, vehicles=dataclasses.replace(state.vehicles, active=active))
            blindly = self._choose(unseen, starts_m, light, may_ask, orders.runs)
            choice = choice.where(orders.blind, blindly)
        v = dataclasses.replace(state.vehicles, **choice.standing)
        danger = None if driven is None else driven.danger
        state = dataclasses.replace(
            state,
            time_s=state.time_s + dt_s,
            step_index=state.step_index + 1,
            vehicles=v,
            people=step_pedestrians(self.walks, state.people, v, starts_m, light, dt_s, rng, danger),
            strays=moved_strays(state.strays, orders.pace_mps, dt_s),
        )
        changed = self._begin_change(state, choice.situation, driven, orders)
        wanted_mps2 = np.minimum(choice.wanted_mps2, orders.most_mps2)
        moved = drive(state.vehicles if changed is None else changed, wanted_mps2, dt_s)
        vehicles = moved.first(self._slot_count) if driven is None else driven.without_shadows(moved)
        state = dataclasses.replace(state, vehicles=vehicles)
        if changed is not None:
            state = self._know_path(state, rng)
        state = self._change_lanes_at_ends(state, rng)
        return self._turnover.renew(state, rng, None if driven is None else driven.centre_m)

    def taken_over(self, state: TrafficState, ego: Driven) -> TrafficState:
        """Return the state in which vehicle 0, driven from outside until now, drives itself again from
        there."""
        seen = self._see_driven(state, ego)
        vehicles = seen.without_shadows(seen.everyone)
        return dataclasses.replace(state, vehicles=vehicles, route_passed=seen.route_passed)

    def stands_back(self, state: TrafficState) -> bool:
        """Return whether vehicle 0 stands at a line without right of way."""
        v = state.vehicles
        if v.speed_mps[0] > HALT_MPS or v.granted[0] > 0:
            return False
        ahead = v.path[0, BEHIND + 1 :]
        contested = (ahead >= 0) & self.lanes.contested[ahead]
        gap_m = path_starts(self.lanes, v.path[:1])[0, BEHIND + 1 :] - v.front_m[0]
        return bool((contested & (gap_m < AT_LINE_M)).any()) and not self.lanes.contested[v.lane[0]]

    def lacks_room(self, state: TrafficState) -> bool:
        """Return whether vehicle 0 needs another lane for its route where a lane change no longer fits."""
        to_route = self._to_route(state)
        return to_route is not None and to_route[1] < LACKS_ROOM_M

    def to_light_m(self, state: TrafficState, in_s: float = 0.0) -> float:
        """Return the distance of vehicle 0 to the next junction of its route, m.

        The distance is infinite inside a junction. It is also infinite if that junction has no light, or if
        its light is green `in_s` seconds from now.
        """
        v, ahead = state.vehicles, state.route[state.route_passed :]
        on_it = np.flatnonzero(self.lanes.contested[ahead])
        shows = self.signals.shows(state.time_s + in_s)
        closed = len(on_it) > 0 and shows[ahead[on_it[0]]] not in (
            LightState.NONE,
            LightState.GREEN,
        )
        if not closed or self.lanes.contested[v.lane[0]]:
            return np.inf
        return float(path_starts(self.lanes, v.path[:1])[0, BEHIND + 1] - v.front_m[0])

    def _choose(
        self,
        state: TrafficState,
        starts_m: Float64[np.ndarray, "M W"],
        light: Int[np.ndarray, "L"],
        may_ask: Bool[np.ndarray, "M"] | None,
        runs: Bool[np.ndarray, "M"],
    ) -> Choice:
        """Choose the acceleration and the right of way of all vehicles from their situations."""
        v = state.vehicles
        ahead = find_leaders(self.lanes, v, starts_m)
        green = (light == LightState.NONE) | (light == LightState.GREEN)
        way = claim_junctions(self.lanes, v, starts_m, ahead, green, state.time_s, may_ask, runs)
        halt_gap = np.minimum(way.line_gap_m, crossing_gap(self.walks, state.people, v, starts_m))
        halt_gap = np.minimum(halt_gap, way.inside_gap_m)
        to_route = self._to_route(state)
        if to_route is not None:
            halt_gap[0] = min(halt_gap[0], max(to_route[1], 0.0))
        situation = see_ahead(self.lanes, v, starts_m, ahead, halt_gap)
        courtesy_mps2 = self._courtesy_mps2(v, to_route, situation, starts_m)
        wanted_mps2 = np.minimum(situation.wanted_mps2(v), courtesy_mps2)
        halted = (v.speed_mps < STOPPED_MPS) & (way.line_gap_m < AT_LINE_M)
        standing = {
            "granted": way.granted,
            "asked_s": way.asked_s,
            "rank": way.rank,
            "has_stopped": v.has_stopped | halted,
        }
        return Choice(standing, wanted_mps2, situation)

    def _see_driven(self, state: TrafficState, ego: Driven) -> SeenDriven:
        known = state.route, state.route_passed, state.time_s
        return see_driven(self.lanes, self.near_lanes, state.vehicles, ego, *known)

    def zone_lights(self, time_s: float) -> Int[np.ndarray, "Z"]:
        """Return the `LightState` of each of the town's stop zones."""
        guarded = np.flatnonzero(self.signals.guarded)
        lights = np.full(self._zone_count, int(LightState.NONE))
        lights[self.lanes.zone[guarded]] = self.signals.shows(time_s)[guarded]
        return lights

    def poses(self, state: TrafficState) -> Poses:
        """Return the poses of all vehicle slots."""
        return vehicle_poses(self.lanes, state.vehicles)

    def actors(self, state: TrafficState) -> list[ActorState]:
        """Return all road users, without vehicle 0 if it is the ego vehicle."""
        v = state.vehicles
        kept = v.active.copy()
        kept[0] &= len(state.route) == 0
        return [
            *vehicle_actors(v, self.poses(state), motion(self.lanes, v), kept),
            *people_actors(state.people),
            *map(stray_actor, state.strays),
        ]

    def _begin_change(
        self, state: TrafficState, situation: Situation, driven: SeenDriven | None, orders: Orders
    ) -> Vehicles | None:
        """Begin the lane change of the one vehicle that has to change or gains most.

        Return None if there is none.
        """
        v = state.vehicles
        if orders.change is not None:
            return begin_change(self.lanes, v, *orders.change)
        fits = (self._for_large | ~is_large(v)[:, None]) & (v.category != Category.BICYCLE)[:, None]
        urge = self._route_urge(state)
        may = who_may_change(self.lanes, self._stretches, v, fits, urge >= HAS_TO_MPS2)
        may &= np.isinf(orders.most_mps2)
        may[:, self._slot_count :] = False  # shadows
        may[:, 0] &= driven is None
        change = choose_change(self.lanes, self._stretches, v, situation, may, urge)
        if change is None:
            return None
        begun = begin_change(self.lanes, v, *change)
        if change[0] == 0 and state.route_passed < len(state.route):
            begun.path[0, BEHIND + 1 :] = -1  # the route decides where to go from the new lane
        return begun

    def _route_urge(self, state: TrafficState) -> Float64[np.ndarray, "2 N"]:
        """Return the value of lane changes to the left and to the right for the route of vehicle 0, m/s²."""
        v, urge = state.vehicles, np.zeros((2, len(state.vehicles.active)))
        if state.route_passed >= len(state.route):
            return urge
        enough_m = SETTLED_M + URGENT_S * v.speed_mps[0]
        to_route = self._to_route(state)
        if to_route is not None:
            side, room_m = to_route
            urge[side, 0] = LIKES_TO_MPS2 if room_m > enough_m else HAS_TO_MPS2
            urge[1 - side, 0] = -np.inf
        else:
            room_m = self._stretches.room_m[:, v.lane[0]] - v.s_m[0]
            urge[:, 0] = np.where(room_m > 2 * enough_m, 0.0, -np.inf)
        return urge

    def _courtesy_mps2(
        self,
        v: Vehicles,
        to_route: tuple[int, float] | None,
        situation: Situation,
        starts_m: Float64[np.ndarray, "N W"],
    ) -> Float64[np.ndarray, "N"]:
        """Return upper limits of the accelerations that let vehicle 0 change lanes where it soon has to,
        m/s²."""
        if to_route is None or to_route[1] > SETTLED_M + URGENT_S * v.speed_mps[0]:
            return np.full(len(v.active), np.inf)
        side, target = to_route[0], np.full(len(v.active), -1)
        target[0] = self._stretches.target[side, v.lane[0]]
        return let_in(self.lanes, v, starts_m, situation, target, side)

    def _to_route(self, state: TrafficState) -> tuple[int, float] | None:
        """Return the side to which vehicle 0 has to change for its route, and the distance in which it can
        still begin."""
        if state.route_passed >= len(state.route) or not state.vehicles.active[0]:
            return None
        wanted = int(state.route[state.route_passed])
        return room_to_change_m(self.lanes, self._stretches, state.vehicles, wanted)

    def _know_path(self, state: TrafficState, rng: np.random.Generator) -> TrafficState:
        """Fill in the lanes ahead that are not known yet."""
        to_come = state.route[state.route_passed :]
        vehicles = extend_paths(self.lanes, self._for_large, state.vehicles, to_come, rng)
        return dataclasses.replace(state, vehicles=vehicles)

    def _change_lanes_at_ends(self, state: TrafficState, rng: np.random.Generator) -> TrafficState:
        while True:
            v = state.vehicles
            over = v.active & (v.s_m >= self.lanes.length_m[v.lane]) & (v.path[:, BEHIND + 1] >= 0)
            if not over.any():
                return state
            path = np.where(
                over[:, None], np.pad(v.path[:, 1:], ((0, 0), (0, 1)), constant_values=-1), v.path
            )
            moved = dataclasses.replace(
                v,
                path=path,
                s_m=np.where(over, v.s_m - self.lanes.length_m[v.lane], v.s_m),
                granted=np.where(over, np.maximum(v.granted - 1, 0), v.granted),
                has_stopped=v.has_stopped & ~over,
            )
            passed = state.route_passed + bool(over[0])
            state = dataclasses.replace(state, vehicles=moved, route_passed=passed)
            state = self._know_path(state, rng)
