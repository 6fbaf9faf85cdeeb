"""Recording of short logs from virtual egos: any car of the running traffic becomes the recording vehicle.

One simulation of traffic serves many egos, so a labelled frame costs little more than its images. Each log
has a few key frames with images, then key frames of boxes, poses and lights alone, which are the true future
of the former. People and cyclists who cross the ego's path or wait beside it are added: in the traffic they
are rare.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int

from foredrive.data.log_paths import LogPath
from foredrive.data.log_writer import Frame, LogWriter
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import Category, VoxelSpec
from foredrive.scene.actors import ActorState, boxes_in_ego_frame, in_box_range
from foredrive.scene.conditions import Conditions, draw_daylight
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.names import is_held_out, map_name
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.recorder import (
    FIRST_TIME_US,
    camera_specs,
    lamps_near,
    traffic_light_states,
    write_town_map,
)
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic.expert import T_path_ego, ego_twist
from foredrive.towns.traffic.lane_graph import LaneControl
from foredrive.towns.traffic.recovery import PathDeviation
from foredrive.towns.traffic.state import TrafficState
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.traffic.vehicles import BEHIND, Poses, Vehicles
from foredrive.towns.world import World

KEY_DT_S, STEP_S = 0.5, 0.1
"""Time between key frames and between steps of the traffic, s."""
IMAGES, LATER = 6, 8
"""Key frames of a log with images, and after them without: the last image has a future of 4 s."""
FORESEEN = 6
"""Key frames after those with images that have occupancy: plans of 3 s are judged from the last one."""
EGOS_PER_WINDOW = 16
"""Most logs that are taken of the same time of the traffic, where nothing else is said."""
VEHICLES, PEOPLE = 90, 40
SETTLE_S, APART_S = 8.0, 1.5
"""Time before the first window and between two of them, s."""
WORLDS = 3
"""Kinds of daylight in which a town is seen where no conditions are given."""
LINE_M, AT_LINE_SHARE = 45.0, 2 / 3
"""Egos with a light or a stop sign within this distance ahead, m, fill this share of a window if there are
enough."""
STANDING_MPS, STANDING_SHARE = 0.5, 0.25
"""Egos that are slower than this, m/s, are at most this share of a window: half of all traffic waits."""
INSERTED_SHARES = (0.1, 0.35, 0.35, 0.2)
"""Shares of the logs with 0, 1, 2 and 3 inserted people or cyclists."""
MEETING_SHARE, MEETING_S = 0.75, 1.5
"""Share of them who cross at most this long before or after the ego comes by, s, if it does."""
MIN_PATH_M, AHEAD_M = 12.0, 150.0
"""Least length of a route, and its length beyond the distance that is driven, m."""
_FIRST_INSERTED_ID = 1_000_000


@dataclass(frozen=True)
class _Moment:
    """The traffic at a key frame."""

    state: TrafficState
    poses: Poses
    actors: list[ActorState]
    lights: Int[np.ndarray, "Z"]


@dataclass(frozen=True)
class _Ego:
    """A car of the traffic that is the recording vehicle over a window."""

    row: int
    route_xyz: Float64[np.ndarray, "M 3"]
    deviation: PathDeviation
    """Deviation of the recording vehicle from the car, which drives in the middle of its lane."""
    at_line: bool
    """A light or a stop sign is ahead."""


@dataclass(frozen=True)
class _Inserted:
    """A person or cyclist who waits, then moves straight on."""

    track_id: int
    category: Category
    size_lwh: Float64[np.ndarray, "3"]
    foot_m: Float64[np.ndarray, "3"]
    """Place on the ground at first, world frame."""
    yaw: float
    speed_mps: float
    waits_s: float
    style: int

    def at(self, t_s: float) -> ActorState:
        """Return the actor at a time since the beginning of the window."""
        # It stands before its time and then moves at a constant velocity
        moving = t_s >= self.waits_s
        velocity = self.speed_mps * moving * np.array([np.cos(self.yaw), np.sin(self.yaw), 0.0])
        # The velocity is 0 while it waits, so the product vanishes
        centre_m = self.foot_m + max(t_s - self.waits_s, 0.0) * velocity
        centre_m[2] += 0.5 * self.size_lwh[2]
        return ActorState(
            self.track_id,
            self.category,
            centre_m,
            self.yaw,
            0.0,
            self.size_lwh,
            velocity,
            self.style,
            False,
        )


def record_virtual_egos(
    town: str,
    seed: int,
    count: int,
    out: Path,
    sensors: SensorSuite,
    conditions: Sequence[Conditions] = (),
    occupancy: VoxelSpec | None = None,
    tick: Callable[[], None] = lambda: None,
    *,
    egos_per_window: int = EGOS_PER_WINDOW,
) -> list[LogPath]:
    """Record `count` short logs of one town. The same arguments give the same bytes on one kind of processor.

    The logs are out/logs/SPLIT/TOWN_seedN_egoNNNN with SPLIT town-egos_train or town-egos_test. Existing ones
    are kept.

    Args:
        town: one of `TOWNS`, a tile, or the path of an OpenDRIVE file.
        seed: seed of the town, its traffic and all that is drawn.
        count: number of logs; each has `IMAGES` key frames with images.
        out: 123D data root.
        sensors: the cameras. A lidar is used if there is one.
        conditions: of which one is drawn for each log. Empty: `WORLDS` kinds of daylight.
        occupancy: grid of the occupancy with flow, recorded for the key frames with images and `FORESEEN`
            after them; None: none is recorded.
        tick: called after each log.
        egos_per_window: largest number of logs that are taken of the same time of the traffic.

    Raises:
        InputError: there is no such town.
        OSError: the disk is full.
    """
    split = split_of(town)
    folders = [
        out / "logs" / split / f"{map_name(town)}_seed{seed}_ego{number:04d}" for number in range(count)
    ]
    # All logs exist: nothing to do
    if all((folder / "sync.arrow").is_file() for folder in folders):  # without growing the town again
        return [LogPath(folder, out / "maps") for folder in folders]
    town_map = load_town_map(town)
    rng = np.random.default_rng((seed, 5))
    first = World(town_map, seed, conditions[0] if conditions else None)
    others = conditions[1:] if conditions else [draw_daylight(rng) for _ in range(WORLDS - 1)]
    worlds = [first, *map(first.under, others)]
    maps = write_town_map(town, out)
    logs: list[LogPath] = []
    for window, egos in _windows(town_map, seed, rng, egos_per_window):
        for ego in egos[: count - len(logs)]:
            of_log = np.random.default_rng((seed, 6, len(logs)))  # whether the logs before are there or not
            path = LogPath(folders[len(logs)], maps)
            # A log gets its final name when it is whole; incomplete ones are recorded again
            if not (path.folder / "sync.arrow").is_file():  # logs get their names when they are whole
                world = worlds[int(of_log.integers(len(worlds)))]
                inserted = _insert_all(window, ego, of_log)
                place = (
                    out,
                    split,
                    path.folder.name,
                    camera_specs(sensors.rig),
                    maps,
                    map_name(town),
                    ego.route_xyz,
                )
                with LogWriter(*place) as writer:
                    for k in range(len(window.moments)):
                        numbers = (seed, len(logs), k)
                        writer.write(_frame(world, window, ego, inserted, k, sensors, numbers, occupancy))
            logs.append(path)
            tick()
        if len(logs) == count:
            return logs
    return logs


def split_of(town: str) -> str:
    """Return the 123D split of a town's virtual egos."""
    return f"town-egos_{'test' if is_held_out(town) else 'train'}"


@dataclass(frozen=True)
class _Window:
    """The traffic of a town over the time of one log."""

    town: TownMap
    traffic: Traffic
    moments: list[_Moment]


def _windows(
    town: TownMap, seed: int, rng: np.random.Generator, most_egos: int
) -> Iterator[tuple[_Window, list[_Ego]]]:
    """Simulate without end, and yield stretches of time with the egos that are taken from each."""
    traffic = Traffic(town, seed, VEHICLES, PEOPLE)
    state = traffic.start()
    wait_s = SETTLE_S
    while True:
        # Let the traffic run between windows, so that they show different situations
        for _ in range(round(wait_s / STEP_S)):
            state = traffic.step(state, STEP_S)
        moments = []
        for k in range(IMAGES + LATER):
            for _ in range(round(KEY_DT_S / STEP_S) if k else 0):
                state = traffic.step(state, STEP_S)
            lights = traffic.zone_lights(state.time_s)
            moments.append(_Moment(state, traffic.poses(state), traffic.actors(state), lights))
        window = _Window(town, traffic, moments)
        yield window, _choose_egos(window, rng, most_egos)
        wait_s = APART_S


def _choose_egos(window: _Window, rng: np.random.Generator, most: int) -> list[_Ego]:
    """Return at most `most` cars that keep their slot and lane sequence over the window, in random order.

    Those that come to a light or a stop sign first, up to their share.
    """
    first, last = window.moments[0].state.vehicles, window.moments[-1].state.vehicles
    # The slot must hold the same vehicle at the end
    lasting = first.active & last.active & (first.track_id == last.track_id)
    rows = np.flatnonzero(lasting & (first.category == int(Category.CAR)))
    rng.shuffle(rows)
    # Of the standing ones only a share is kept
    standing = rows[first.speed_mps[rows] < STANDING_MPS][round(STANDING_SHARE * most) :]
    rows = rows[~np.isin(rows, standing)]
    egos = []
    for row in rows.tolist():
        route = _route(window, row)
        if route is not None:
            # Half of the egos drive a little beside the middle of the lane, or turned, as a learner does.
            lateral_m, yaw_rad = rng.normal(0.0, (0.35, 0.05)) * (rng.random(2) < 0.5)
            deviation = PathDeviation(lateral_m=float(lateral_m), yaw_rad=float(yaw_rad))
            egos.append(_Ego(row, route, deviation, _comes_to_line(window, row)))
    # Egos with a line ahead first, then the others
    at_line = [ego for ego in egos if ego.at_line][: round(AT_LINE_SHARE * most)]
    others = [ego for ego in egos if ego not in at_line]
    return (at_line + others)[:most]


def _route(window: _Window, row: int) -> Float64[np.ndarray, "M 3"] | None:
    """Return the middle of the lanes of a car from beside its rear axle on; None if it changes lanes."""
    before, after = (window.moments[k].state.vehicles.path[row] for k in (0, -1))
    # The rear axle may still be in the lane before that of the middle of the car.
    ahead = [lane for lane in before[BEHIND - 1 :].tolist() if lane >= 0]
    if int(after[BEHIND]) not in ahead:
        return None
    # Lanes between the first and the last moment, and the lanes that follow
    lanes = ahead[: ahead.index(int(after[BEHIND]))] + [lane for lane in after[BEHIND:].tolist() if lane >= 0]
    parts = [window.traffic.lanes.samples(lane) for lane in lanes]
    xyz = np.concatenate(parts)
    begin_m, end_m = (window.moments[k].poses.axle_xyz[row] for k in (0, -1))
    # Looked for in the first lanes alone: a route may come by here again.
    first = int(np.hypot(*(np.concatenate(parts[:2])[:, :2] - begin_m[:2]).T).argmin())
    # Leave out repeated points where lanes join
    step_m = np.hypot(*np.diff(xyz[first:, :2], axis=0).T)
    xyz = xyz[first:][np.concatenate([[True], step_m > 0.05])]
    arc_m = arc_lengths(xyz)
    reach_m = float(np.linalg.norm(end_m - begin_m)) + AHEAD_M
    return xyz[arc_m <= reach_m] if arc_m[-1] > MIN_PATH_M else None


def _comes_to_line(window: _Window, row: int) -> bool:
    """Return whether a lane behind a light or a stop sign begins ahead of a car within `LINE_M` at first."""
    vehicles, lanes = window.moments[0].state.vehicles, window.traffic.lanes
    path = vehicles.path[row, BEHIND:]
    path = path[path >= 0]
    # Distance from the front bumper to the end of each lane, which is the start of the next one
    gap_m = np.cumsum(lanes.length_m[path]) - vehicles.front_m[row]
    is_behind_line = window.traffic.signals.guarded | (lanes.control == LaneControl.STOP)
    return bool((is_behind_line[path[1:]] & (gap_m[:-1] < LINE_M)).any())


def _insert_all(window: _Window, ego: _Ego, rng: np.random.Generator) -> list[_Inserted]:
    """Draw people and cyclists who stand beside the ego's path, or cross it ahead of the ego."""
    count = int(rng.choice(len(INSERTED_SHARES), p=INSERTED_SHARES))
    drawn = [_insert(window, ego, _FIRST_INSERTED_ID + number, rng) for number in range(count)]
    return [inserted for inserted in drawn if inserted is not None]


def _insert(window: _Window, ego: _Ego, track_id: int, rng: np.random.Generator) -> _Inserted | None:
    """Draw a person or cyclist. Cyclists at the kerb face the road before they ride."""
    arc_m = arc_lengths(ego.route_xyz)
    ahead_m = rng.uniform(8.0, 45.0)
    if ahead_m + 1.0 > arc_m[-1]:
        return None
    # Place on the route, and the heading from a point 1 m further on
    place, further = points_at(ego.route_xyz, arc_m, np.array([ahead_m, ahead_m + 1.0]))
    heading = float(np.arctan2(*(further - place)[1::-1]))
    cycles = rng.random() < 0.6
    side = float(rng.choice([-1.0, 1.0]))
    beside_m = rng.uniform(2.0, 15.0 if cycles else 12.0)
    # Beside the road on either side, facing across it
    foot_m = place + side * beside_m * np.array([-np.sin(heading), np.cos(heading), 0.0])
    yaw = heading - side * 0.5 * np.pi + rng.normal(0.0, 0.25)
    if rng.random() < 0.15:  # along the road in place of across it
        yaw += 0.5 * np.pi * rng.choice([-1.0, 1.0])
    speed_mps = float(rng.uniform(3.5, 6.0) if cycles else rng.uniform(0.6, 2.5))
    # Most of them start at a random time, some never
    waits_s = float(rng.uniform(-1.0, 6.0)) if rng.random() < 0.85 else np.inf
    comes_s = _comes_by_s(window, ego, float(ahead_m))
    # If the ego comes by, most start so that they meet it at about that time
    if rng.random() < MEETING_SHARE and comes_s is not None:
        waits_s = comes_s + float(rng.uniform(-MEETING_S, MEETING_S)) - beside_m / speed_mps
    return _Inserted(
        track_id,
        Category.BICYCLE if cycles else Category.PEDESTRIAN,
        np.array([1.75, 0.6, 1.7] if cycles else [0.5, 0.55, 1.72]),
        foot_m,
        float(yaw),
        speed_mps,
        waits_s,
        int(rng.integers(2**31)),
    )


def _comes_by_s(window: _Window, ego: _Ego, ahead_m: float) -> float | None:
    """Return the time in the window at which an ego has driven some way; None: it does not."""
    xyz = np.stack([moment.poses.axle_xyz[ego.row] for moment in window.moments])
    driven_m = arc_lengths(xyz)
    if driven_m[-1] < ahead_m:
        return None
    return float(np.interp(ahead_m, driven_m, KEY_DT_S * np.arange(len(driven_m))))


def _frame(
    world: World,
    window: _Window,
    ego: _Ego,
    inserted: list[_Inserted],
    k: int,
    sensors: SensorSuite,
    seed: tuple[int, int, int],
    occupancy: VoxelSpec | None,
) -> Frame:
    """Return the recorded data of one key frame; from `IMAGES` on without images."""
    moment = window.moments[k]
    vehicles: Vehicles = moment.state.vehicles.rows(slice(ego.row, ego.row + 1))
    # The recording vehicle deviates from the car that it replaces, and so do pose and motion
    T_world_ego = moment.poses.axle_frame(ego.row) @ T_path_ego(ego.deviation)
    twist = ego_twist(window.traffic.lanes, vehicles, T_world_ego, ego.deviation)
    actors = [actor for actor in moment.actors if actor.track_id != int(vehicles.track_id[0])]
    actors += [person.at(KEY_DT_S * k) for person in inserted]
    near = in_box_range([*actors, *world.parked], T_world_ego)
    occupied = None
    if occupancy is not None and k < IMAGES + FORESEEN:
        occupied = world.occupancy(actors, T_world_ego, occupancy)
    # Later key frames have no sensor data: they are the future of the others
    images, sweep, visibility = {}, None, None
    if k < IMAGES:
        noise_seed = int(np.random.SeedSequence(seed).generate_state(1)[0])
        rendered = world.render(actors, sensors, T_world_ego, twist, noise_seed, moment.lights)
        images, sweep = rendered.images, rendered.sweep
        visibility = world.visibility(near, sensors, T_world_ego, rendered)
    return Frame(
        t_us=FIRST_TIME_US + round(moment.state.time_s * 1e6),
        T_world_ego=T_world_ego,
        velocity_ego_mps=twist[:3],
        acceleration_ego_mps2=np.array([float(vehicles.acceleration_mps2[0]), twist[0] * twist[5], 0.0]),
        images=images,
        sweep=sweep,
        boxes=boxes_in_ego_frame(near, T_world_ego),
        visibility=visibility,
        occupancy=occupied,
        traffic_lights=traffic_light_states(window.town, moment.lights),
        signal_lamps=lamps_near(window.town, world.signal_xyz, T_world_ego),
    )
