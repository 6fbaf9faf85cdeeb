"""Spawning: vehicles and people appear and disappear out of the ego vehicle's sight."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.towns.traffic.drivers import driving_context
from foredrive.towns.traffic.fleet import StartPoints, draw_fleet, place_vehicles
from foredrive.towns.traffic.lane_graph import MOTORWAY_LIMIT_MPS, LaneGraph
from foredrive.towns.traffic.leaders import STANDSTILL_M, find_leaders
from foredrive.towns.traffic.paths import extend_paths
from foredrive.towns.traffic.pedestrians import draw_people
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.vehicles import Vehicles, desired_speed, path_starts, vehicle_poses
from foredrive.towns.traffic.walkways import WalkGraph

SPAWN_MIN_M = 95.0
SPAWN_MAX_M = 140.0
DESPAWN_M = 160.0
PEOPLE_SPAWN_MIN_M = 82.0
PEOPLE_SPAWN_MAX_M = 95.0
PEOPLE_DESPAWN_M = 110.0
CLEAR_M = 10.0
CLEAR_S = 3.5
"""Minimum distances of a new vehicle: `CLEAR_M` to all others, and `CLEAR_S` more to those ahead and
behind."""
TRIES = 12
SPAWN_BRAKING_MPS2 = 1.0
"""Maximum deceleration, m/s², of a new vehicle and of the one behind it. A vehicle does not start where one
of them would have to brake harder."""


class Spawner:
    """The spawning of traffic in free slots; of the vehicle slots only the first `vehicle_count` are used."""

    def __init__(
        self,
        lanes: LaneGraph,
        walks: WalkGraph,
        starts: StartPoints,
        for_large: Bool[np.ndarray, "L"],
        vehicle_count: int,
    ) -> None:
        self._vehicle_count = vehicle_count
        self._lanes, self._walks, self._starts, self._for_large = lanes, walks, starts, for_large
        self._is_open = bool((lanes.successor_count == 0).any())
        self._for_bicycles = lanes.limit_mps <= MOTORWAY_LIMIT_MPS
        # People appear on walkways, with a probability that grows with the length
        walkable = np.where(walks.is_crossing, 0.0, walks.length_m)
        self._walk_weight = walkable / max(walkable.sum(), 1e-9)

    def spawn_all(self, state: TrafficState, rng: np.random.Generator) -> TrafficState:
        """Place vehicles and people in all free slots, as far as there is room."""
        ego_m = vehicle_poses(self._lanes, state.vehicles).centre_m[0] if len(state.route) else None
        state = self._spawn_vehicles(state, 0.0, len(state.vehicles.active), rng, ego_m)
        return self._spawn_people(state, 0.0, len(state.people.active), rng, ego_m)

    def update(
        self,
        state: TrafficState,
        rng: np.random.Generator,
        ego_m: Float64[np.ndarray, "3"] | None = None,
    ) -> TrafficState:
        """Remove road users that are far from the ego vehicle, and add up to one vehicle and one person out
        of its sight.

        Without an ego vehicle, vehicles that leave the map are the only ones to be replaced.

        Args:
            ego_m: position of the ego vehicle if it is driven from outside, m.
        """
        # Those whose front is beyond the end of a lane that leads nowhere
        v = state.vehicles
        left = (
            v.active & (v.front_m > self._lanes.length_m[v.lane]) & (self._lanes.successor_count[v.lane] == 0)
        )
        left[0] &= not len(state.route)
        if left.any():
            state = dataclasses.replace(state, vehicles=dataclasses.replace(v, active=v.active & ~left))
        if not len(state.route):
            return self._spawn_vehicles(state, 0.0, 1, rng, None) if self._is_open else state
        centre_m = vehicle_poses(self._lanes, state.vehicles).centre_m
        # An ego vehicle off its lane is where it was driven to
        if ego_m is not None:
            centre_m[0] = ego_m
        # Beyond the range it cannot be seen any more
        far = np.linalg.norm(centre_m - centre_m[0], axis=1) > DESPAWN_M
        far_off = np.linalg.norm(state.people.xyz - centre_m[0], axis=1) > PEOPLE_DESPAWN_M
        vehicles = dataclasses.replace(state.vehicles, active=state.vehicles.active & ~far)
        people = dataclasses.replace(state.people, active=state.people.active & ~far_off)
        state = dataclasses.replace(state, vehicles=vehicles, people=people)
        # New ones appear farther away than the ego vehicle can see, but within the simulated region
        state = self._spawn_vehicles(state, SPAWN_MIN_M, 1, rng, centre_m[0])
        return self._spawn_people(state, PEOPLE_SPAWN_MIN_M, 1, rng, centre_m[0])

    def _spawn_vehicles(
        self,
        state: TrafficState,
        beyond_m: float,
        max_count: int,
        rng: np.random.Generator,
        ego_m: Float64[np.ndarray, "3"] | None,
    ) -> TrafficState:
        """Place new vehicles in up to `max_count` free slots, at least `beyond_m` from an ego vehicle."""
        rows = np.flatnonzero(~state.vehicles.active[: self._vehicle_count])[:max_count]
        places = np.arange(len(self._starts.lane))
        if ego_m is not None and len(rows):
            distance = np.linalg.norm(self._starts.xyz - ego_m, axis=1)
            places = np.flatnonzero((distance >= beyond_m) & (distance <= SPAWN_MAX_M))
        if not len(rows) or not len(places):
            return state
        vehicles = state.vehicles
        for k, row in enumerate(rows.tolist()):
            # Several tries at random places; the first that works is taken
            tries = rng.choice(places, TRIES)
            for start in tries[self._is_free(vehicles, tries)].tolist():
                spawned = self._try_spawn(vehicles, row, start, state.next_track_id + k, rng)
                if spawned is not None:
                    vehicles = spawned
                    break
        return dataclasses.replace(state, vehicles=vehicles, next_track_id=state.next_track_id + len(rows))

    def _is_free(self, vehicles: Vehicles, starts: Int[np.ndarray, "k"]) -> Bool[np.ndarray, "k"]:
        """Return for each start whether it is far enough from all vehicles, and in time from those ahead and
        behind."""
        centres = vehicle_poses(self._lanes, vehicles).centre_m[vehicles.active]
        # Offset of all vehicles in the frame of each start
        offset = centres[None] - self._starts.xyz[starts][:, None]
        forward = self._starts.forward[starts][:, None]
        along = np.sum(offset * forward, axis=2)
        lateral = np.linalg.norm(offset - along[..., None] * forward, axis=2)
        speed = self._lanes.speed(self._starts.lane[starts], self._starts.s_m[starts])
        # Ahead and behind on the same lane (less than 3 m aside), more distance is needed at speed
        reach = CLEAR_M + CLEAR_S * speed[:, None]
        clear = (np.hypot(along, lateral) >= CLEAR_M) & ((np.abs(along) >= reach) | (lateral >= 3.0))
        return np.asarray(clear.all(axis=1))

    def _try_spawn(
        self, vehicles: Vehicles, row: int, start: int, track_id: int, rng: np.random.Generator
    ) -> Vehicles | None:
        """Return the vehicles with a new one in a slot, slow enough that it can brake for the vehicle ahead
        of it.

        Return None if one vehicle would have to brake for another.
        """
        lane = self._starts.lane[[start]]
        one = draw_fleet(rng, np.array([track_id]), self._for_large[lane], self._for_bicycles[lane])
        one = place_vehicles(self._lanes, one, lane, self._starts.s_m[[start]])
        v = vehicles.replace_rows(np.array([row]), one)
        # Draw its turns, so that its leader on the path is known
        nowhere = np.zeros(0, dtype=np.int64)
        v = extend_paths(self._lanes, self._for_large, v, nowhere, rng)
        starts_m = path_starts(self._lanes, v.path)
        leaders = find_leaders(self._lanes, v, starts_m)
        speed = v.speed_mps.copy()
        speed[row] = min(speed[row], desired_speed(self._lanes, v, starts_m)[row])
        # v² = v_leader² + 2 b s: slow enough to brake gently behind the leader
        if leaders.leader[row] >= 0:
            room_m = max(leaders.leader_gap_m[row] - STANDSTILL_M, 0.0)
            leader_mps = v.speed_mps[leaders.leader[row]]
            speed[row] = min(speed[row], np.sqrt(leader_mps**2 + 2 * SPAWN_BRAKING_MPS2 * room_m))
        v = dataclasses.replace(v, speed_mps=speed)
        leaders = find_leaders(self._lanes, v, starts_m)  # the leaders of the others depend on its speed
        no_halt = np.full(len(speed), np.inf)
        # Accept only if neither it nor a follower has to brake hard at once
        wanted = driving_context(self._lanes, v, starts_m, leaders, no_halt).desired_mps2(v)
        concerned = ((leaders.leader == row) | (leaders.limiting == row)) & v.active
        concerned[row] = True
        return v if wanted[concerned].min() > -SPAWN_BRAKING_MPS2 else None

    def _spawn_people(
        self,
        state: TrafficState,
        beyond_m: float,
        max_count: int,
        rng: np.random.Generator,
        ego_m: Float64[np.ndarray, "3"] | None,
    ) -> TrafficState:
        """Place people in up to `max_count` free slots."""
        rows = np.flatnonzero(~state.people.active)[:max_count]
        if not len(rows):
            return state
        # Walks by length, and a uniform place on each
        tries = rng.choice(len(self._walk_weight), size=(len(rows), TRIES), p=self._walk_weight)
        s_m = rng.random(tries.shape) * self._walks.length_m[tries]
        xyz = self._walks.position(tries.ravel(), s_m.ravel()).reshape(*tries.shape, 3)
        ok = np.ones(tries.shape, dtype=np.bool_)
        if ego_m is not None:
            distance = np.linalg.norm(xyz - ego_m, axis=2)
            ok = (distance >= beyond_m) & (distance <= PEOPLE_SPAWN_MAX_M)
        # The first try that fits; people without one wait for the next step
        chosen = np.argmax(ok, axis=1)
        has_place = ok.any(axis=1)
        row_range = np.arange(len(rows))
        walk, s = tries[row_range, chosen][has_place], s_m[row_range, chosen][has_place]
        ids = state.next_track_id + np.flatnonzero(has_place)
        people = state.people.replace_rows(rows[has_place], draw_people(self._walks, rng, ids, walk, s))
        return dataclasses.replace(state, people=people, next_track_id=state.next_track_id + len(rows))
