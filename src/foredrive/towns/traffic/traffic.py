"""Traffic on a town's lanes and walkways, as a pure function from one state to the next."""

import dataclasses
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.scene import Category
from foredrive.scene.actors import ActorState
from foredrive.scene.traffic_light import LightState
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.traffic.appearance import people_actors, scripted_actor_state, vehicle_actors
from foredrive.towns.traffic.drivers import Decision, DrivingContext, driving_context, move_vehicles
from foredrive.towns.traffic.external_ego import (
    AT_LINE_M,
    EgoPose,
    PerceivedEgo,
    perceive_ego,
    scripted_actor_shadows,
)
from foredrive.towns.traffic.fleet import LARGE_RADIUS_M, StartPoints, find_start_points, is_large
from foredrive.towns.traffic.lane_changes import (
    CHANGE_SPACING_M,
    DISCRETIONARY_MPS2,
    MANDATORY_MPS2,
    URGENT_S,
    begin_change,
    choose_change,
    courtesy_limits,
    find_change_ranges,
    lane_change_allowed,
    room_to_change_m,
)
from foredrive.towns.traffic.lane_graph import LaneGraph, build_lane_graph, lanes_for
from foredrive.towns.traffic.lane_index import LaneIndex, build_lane_index
from foredrive.towns.traffic.leaders import find_leaders
from foredrive.towns.traffic.lights import SignalPlan, plan_signals
from foredrive.towns.traffic.orders import Orders
from foredrive.towns.traffic.paths import extend_paths
from foredrive.towns.traffic.pedestrians import crossing_gap, empty_pedestrians, step_pedestrians
from foredrive.towns.traffic.right_of_way import claim_junctions
from foredrive.towns.traffic.scripted_actors import step_scripted_actors
from foredrive.towns.traffic.spawning import Spawner
from foredrive.towns.traffic.state import TrafficState
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
MIN_CHANGE_ROOM_M = 1.0
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
        scenario_slot_count: additional slots, after those of the vehicles, for vehicles that the caller adds.
    """

    def __init__(
        self, town: TownMap, seed: int, vehicle_count: int, people_count: int, scenario_slot_count: int = 0
    ) -> None:
        self.seed = seed
        self.lanes: LaneGraph = build_lane_graph(town)
        self.walks: WalkGraph = build_walk_graph(town, self.lanes)
        self.signals: SignalPlan = plan_signals(self.lanes, np.random.default_rng((seed, 0)))
        self.starts: StartPoints = find_start_points(self.lanes)
        self._zone_count = len(town.stop_zones)
        self._change_ranges = find_change_ranges(self.lanes)
        self._for_large = lanes_for(self.lanes, LARGE_RADIUS_M)
        self._slot_count = vehicle_count + scenario_slot_count
        self.scenario_slots = range(vehicle_count, self._slot_count)
        self._people_count = people_count if len(self.walks.length_m) else 0
        self._spawner = Spawner(self.lanes, self.walks, self.starts, self._for_large, vehicle_count)

    @cached_property
    # A town without walkways has no people
    def lane_index(self) -> LaneIndex:
        """Return the town's lanes, searchable by position."""
        return build_lane_index(self.lanes)

    def start(self, ego: Vehicles | None = None, route: Int[np.ndarray, "R"] | None = None) -> TrafficState:
        """Return the initial state, with vehicles and people placed.

        Args:
            ego: a placed vehicle that becomes vehicle 0. Without one, traffic fills the whole town.
            route: the lane in which vehicle 0 has to be at the end of each stretch, from its current stretch
                on. After the last one it takes random turns.
        """
        # Every use of random numbers has a generator of its own, seeded by purpose
        rng = np.random.default_rng((self.seed, 1))
        lanes = np.zeros(0, dtype=np.int64) if route is None else route
        state = TrafficState(
            time_s=0.0,
            step_index=0,
            vehicles=empty_slots(self._slot_count),
            people=empty_pedestrians(self._people_count),
            next_track_id=1,
            route=lanes,
            route_passed=0,
        )
        if ego is not None:
            vehicles = state.vehicles.replace_rows(np.array([0]), ego)
            state = dataclasses.replace(state, vehicles=vehicles, route=lanes if len(lanes) else ego.lane)
            state = self._extend_paths(state, rng)
        return self._spawner.spawn_all(state, rng)

    def step(
        self, state: TrafficState, dt_s: float, ego: EgoPose | None = None, orders: Orders | None = None
    ) -> TrafficState:
        """Return the state one time step later. Equal arguments give equal results.

        Args:
            ego: the pose and motion of vehicle 0 at the time of `state` if it is driven from outside, on the
                road or off it. All others react to it, and its motion is not decided here. None: it drives by
                the same rules as the others.
            orders: orders for some of the other road users. None: no orders, and scripted actors stand still.
        """
        # Seeded by step: equal states give equal steps, also after unpickling
        rng = np.random.default_rng((self.seed, 2, state.step_index))
        # Vehicle 0 from outside: put it on its lane, and its shadows on the other lanes that it blocks
        perceived = None if ego is None else self._perceive_ego(state, ego)
        may_request = None if perceived is None else perceived.may_request
        if perceived is not None:
            route_passed = perceived.route_passed
            state = dataclasses.replace(state, vehicles=perceived.vehicles, route_passed=route_passed)
        count = len(state.vehicles.active)
        # Shadows of scripted actors come after those of vehicle 0
        if state.scripted_actors:
            shadows = scripted_actor_shadows(self.lanes, self.lane_index, state.scripted_actors)
            state = dataclasses.replace(state, vehicles=state.vehicles.appended(shadows))
            if may_request is not None:
                may_request = np.pad(may_request, (0, len(shadows.active)), constant_values=True)
        starts_m = path_starts(self.lanes, state.vehicles.path)
        # Shadows have no orders
        orders = (orders or Orders.none(self._slot_count)).padded(len(state.vehicles.active))
        light = self.signals.light_states(state.time_s)
        decision = self._decide(state, starts_m, light, may_request, orders.runs_lights)
        # Vehicles that ignore vehicle 0 decide in a world without it and without its shadows
        if orders.ignores_ego.any():
            active = state.vehicles.active.copy()
            # Rows from the slots up to `known` are the shadows of vehicle 0
            active[[0, *range(self._slot_count, count)]] = False
            unseen = dataclasses.replace(state, vehicles=dataclasses.replace(state.vehicles, active=active))
            blindly = self._decide(unseen, starts_m, light, may_request, orders.runs_lights)
            decision = decision.where(orders.ignores_ego, blindly)
        v = dataclasses.replace(state.vehicles, **decision.right_of_way)
        danger = None if perceived is None else perceived.is_endangered
        state = dataclasses.replace(
            # People and scripted actors react to the state before this step's motion of the vehicles
            state,
            time_s=state.time_s + dt_s,
            step_index=state.step_index + 1,
            vehicles=v,
            people=step_pedestrians(self.walks, state.people, v, starts_m, light, dt_s, rng, danger),
            scripted_actors=step_scripted_actors(state.scripted_actors, orders.scripted_mps, dt_s),
        )
        # A lane change replaces the path; then all move by the accelerations decided before it
        changed = self._begin_change(state, decision.context, perceived, orders)
        desired_mps2 = np.minimum(decision.desired_mps2, orders.max_mps2)
        moved = move_vehicles(state.vehicles if changed is None else changed, desired_mps2, dt_s)
        # Drop the shadows
        own = slice(self._slot_count)
        vehicles = moved.rows(own) if perceived is None else perceived.without_shadows(moved)
        state = dataclasses.replace(state, vehicles=vehicles)
        # The lanes beyond the new path are drawn or taken from the route
        if changed is not None:
            state = self._extend_paths(state, rng)
        state = self._change_lanes_at_ends(state, rng)
        return self._spawner.update(state, rng, None if perceived is None else perceived.centre_m)

    def with_own_driver(self, state: TrafficState, ego: EgoPose) -> TrafficState:
        """Return the state in which vehicle 0, driven from outside until now, drives itself again from
        there."""
        seen = self._perceive_ego(state, ego)
        vehicles = seen.without_shadows(seen.vehicles)
        return dataclasses.replace(state, vehicles=vehicles, route_passed=seen.route_passed)

    def waits_at_line(self, state: TrafficState) -> bool:
        """Return whether vehicle 0 stands at a line without right of way."""
        v = state.vehicles
        if v.speed_mps[0] > HALT_MPS or v.granted[0] > 0:
            return False
        # Contested lanes ahead whose line is close
        ahead = v.path[0, BEHIND + 1 :]
        contested = (ahead >= 0) & self.lanes.contested[ahead]
        gap_m = path_starts(self.lanes, v.path[:1])[0, BEHIND + 1 :] - v.front_m[0]
        return bool((contested & (gap_m < AT_LINE_M)).any()) and not self.lanes.contested[v.lane[0]]

    def lacks_change_room(self, state: TrafficState) -> bool:
        """Return whether vehicle 0 needs another lane for its route where a lane change no longer fits."""
        change_to_route = self._change_to_route(state)
        return change_to_route is not None and change_to_route[1] < MIN_CHANGE_ROOM_M

    def to_light_m(self, state: TrafficState, in_s: float = 0.0) -> float:
        """Return the distance of vehicle 0 to the next junction of its route, m.

        The distance is infinite inside a junction. It is also infinite if that junction has no light, or if
        its light is green `in_s` seconds from now.
        """
        v, ahead = state.vehicles, state.route[state.route_passed :]
        # Columns of the route that need right of way; the first one's light decides
        on_it = np.flatnonzero(self.lanes.contested[ahead])
        shows = self.signals.light_states(state.time_s + in_s)
        closed = len(on_it) > 0 and shows[ahead[on_it[0]]] not in (LightState.NONE, LightState.GREEN)
        if not closed or self.lanes.contested[v.lane[0]]:
            return np.inf
        return float(path_starts(self.lanes, v.path[:1])[0, BEHIND + 1] - v.front_m[0])

    def _decide(
        self,
        state: TrafficState,
        starts_m: Float64[np.ndarray, "M W"],
        light: Int[np.ndarray, "L"],
        may_request: Bool[np.ndarray, "M"] | None,
        runs: Bool[np.ndarray, "M"],
    ) -> Decision:
        """Decide the acceleration and the right of way of all vehicles."""
        v = state.vehicles
        leaders = find_leaders(self.lanes, v, starts_m)
        # Yellow counts as closed
        green = (light == LightState.NONE) | (light == LightState.GREEN)
        way = claim_junctions(self.lanes, v, starts_m, leaders, green, state.time_s, may_request, runs)
        # Stop for the nearest of: line of the junction, people on a crossing, vehicles with priority inside
        halt_gap = np.minimum(way.line_gap_m, crossing_gap(self.walks, state.people, v, starts_m))
        halt_gap = np.minimum(halt_gap, way.inside_gap_m)
        change_to_route = self._change_to_route(state)
        # Vehicle 0 waits at the last place from which it can still reach its route
        if change_to_route is not None:
            halt_gap[0] = min(halt_gap[0], max(change_to_route[1], 0.0))
        context = driving_context(self.lanes, v, starts_m, leaders, halt_gap)
        courtesy_mps2 = self._courtesy_limits(v, change_to_route, context, starts_m)
        # Let vehicle 0 in where it has to change lanes
        desired_mps2 = np.minimum(context.desired_mps2(v), courtesy_mps2)
        # A stop counts where the line is close
        halted = (v.speed_mps < STOPPED_MPS) & (way.line_gap_m < AT_LINE_M)
        right_of_way = {
            "granted": way.granted,
            "requested_s": way.requested_s,
            "rank": way.rank,
            "has_stopped": v.has_stopped | halted,
        }
        return Decision(right_of_way, desired_mps2, context)

    def _perceive_ego(self, state: TrafficState, ego: EgoPose) -> PerceivedEgo:
        ego_route = state.route, state.route_passed, state.time_s
        return perceive_ego(self.lanes, self.lane_index, state.vehicles, ego, *ego_route)

    def zone_lights(self, time_s: float) -> Int[np.ndarray, "Z"]:
        """Return the `LightState` of each of the town's stop zones."""
        guarded = np.flatnonzero(self.signals.guarded)
        lights = np.full(self._zone_count, int(LightState.NONE))
        lights[self.lanes.zone[guarded]] = self.signals.light_states(time_s)[guarded]
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
            *map(scripted_actor_state, state.scripted_actors),
        ]

    def _begin_change(
        self, state: TrafficState, context: DrivingContext, perceived: PerceivedEgo | None, orders: Orders
    ) -> Vehicles | None:
        """Begin the lane change of the one vehicle that has to change or gains most.

        Return None if there is none.
        """
        v = state.vehicles
        if orders.change is not None:
            return begin_change(self.lanes, v, *orders.change)
        fits = (self._for_large | ~is_large(v)[:, None]) & (v.category != Category.BICYCLE)[:, None]
        bonus = self._route_bonus(state)
        # Bicycles stay in their lane, large vehicles out of tight curves
        may = lane_change_allowed(self.lanes, self._change_ranges, v, fits, bonus >= MANDATORY_MPS2)
        may &= np.isinf(orders.max_mps2)
        may[:, self._slot_count :] = False  # shadows
        # From outside, vehicle 0 changes lanes by being driven there
        may[:, 0] &= perceived is None
        change = choose_change(self.lanes, self._change_ranges, v, context, may, bonus)
        if change is None:
            return None
        begun = begin_change(self.lanes, v, *change)
        if change[0] == 0 and state.route_passed < len(state.route):
            begun.path[0, BEHIND + 1 :] = -1  # the route decides where to go from the new lane
        return begun

    def _route_bonus(self, state: TrafficState) -> Float64[np.ndarray, "2 N"]:
        """Return the value of lane changes to the left and to the right for the route of vehicle 0, m/s²."""
        v, bonus = state.vehicles, np.zeros((2, len(state.vehicles.active)))
        if state.route_passed >= len(state.route):
            return bonus
        # Distance at which a change for the route becomes mandatory
        enough_m = CHANGE_SPACING_M + URGENT_S * v.speed_mps[0]
        change_to_route = self._change_to_route(state)
        if change_to_route is not None:
            side, room_m = change_to_route
            # Towards the route: a small bonus far away, a large one close to the end
            bonus[side, 0] = DISCRETIONARY_MPS2 if room_m > enough_m else MANDATORY_MPS2
            bonus[1 - side, 0] = -np.inf
        else:
            # In the right lane already: leave it only with ample room to come back
            room_m = self._change_ranges.room_m[:, v.lane[0]] - v.s_m[0]
            bonus[:, 0] = np.where(room_m > 2 * enough_m, 0.0, -np.inf)
        return bonus

    def _courtesy_limits(
        self,
        v: Vehicles,
        change_to_route: tuple[int, float] | None,
        context: DrivingContext,
        starts_m: Float64[np.ndarray, "N W"],
    ) -> Float64[np.ndarray, "N"]:
        """Return upper limits of the accelerations that let vehicle 0 change lanes where it soon has to,
        m/s²."""
        if change_to_route is None or change_to_route[1] > CHANGE_SPACING_M + URGENT_S * v.speed_mps[0]:
            return np.full(len(v.active), np.inf)
        # Only vehicle 0 needs room; the others have no target
        side, target = change_to_route[0], np.full(len(v.active), -1)
        target[0] = self._change_ranges.target[side, v.lane[0]]
        return courtesy_limits(self.lanes, v, starts_m, context, target, side)

    def _change_to_route(self, state: TrafficState) -> tuple[int, float] | None:
        """Return the side to which vehicle 0 has to change for its route, and the distance in which it can
        still begin."""
        if state.route_passed >= len(state.route) or not state.vehicles.active[0]:
            return None
        wanted = int(state.route[state.route_passed])
        return room_to_change_m(self.lanes, self._change_ranges, state.vehicles, wanted)

    def _extend_paths(self, state: TrafficState, rng: np.random.Generator) -> TrafficState:
        """Fill in the lanes ahead that are not known yet."""
        to_come = state.route[state.route_passed :]
        vehicles = extend_paths(self.lanes, self._for_large, state.vehicles, to_come, rng)
        return dataclasses.replace(state, vehicles=vehicles)

    def _change_lanes_at_ends(self, state: TrafficState, rng: np.random.Generator) -> TrafficState:
        # A vehicle may pass several short lanes within one step
        while True:
            v = state.vehicles
            over = v.active & (v.s_m >= self.lanes.length_m[v.lane]) & (v.path[:, BEHIND + 1] >= 0)
            if not over.any():
                return state
            # Shift the window of the path by one lane; the last column becomes unknown
            path = np.where(
                over[:, None], np.pad(v.path[:, 1:], ((0, 0), (0, 1)), constant_values=-1), v.path
            )
            moved = dataclasses.replace(
                v,
                path=path,
                s_m=np.where(over, v.s_m - self.lanes.length_m[v.lane], v.s_m),
                # Grants count lanes ahead; a stop belongs to the line that has been passed
                granted=np.where(over, np.maximum(v.granted - 1, 0), v.granted),
                has_stopped=v.has_stopped & ~over,
            )
            passed = state.route_passed + bool(over[0])
            state = dataclasses.replace(state, vehicles=moved, route_passed=passed)
            state = self._extend_paths(state, rng)
