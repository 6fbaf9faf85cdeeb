"""The expert: a privileged driver that follows a route as vehicle 0 of the traffic.

All others react to it.

It plans its speed as all drivers do, from the exact state of the others, the lights and the curves ahead
(car_following, right_of_way). It changes lanes for its route and to pass slow vehicles (lane_changes). It
steers so that the rear axle stays on its path.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial.transform import Rotation

from foredrive.errors import InputError
from foredrive.scene import Command
from foredrive.scene.actors import ActorState
from foredrive.towns.traffic.fleet import StartPoints, ego_vehicle
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.recovery import PathDeviation, step_deviation
from foredrive.towns.traffic.routes import Route, draw_route
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.traffic.vehicles import (
    MOTION_S,
    Poses,
    Vehicles,
    motion,
    vehicle_poses,
)

MAX_STEP_S = 0.1
SETTLE_S = 6.0
MAX_SETTLE_S = 30.0
MOVING_MPS = 3.0
"""Conditions for the start of a drive: traffic has left its unrealistic initial state, and the ego vehicle
moves."""
ROUTE_MARGIN_M = 60.0


@dataclass(frozen=True)
class DriveSnapshot:
    """The state of the world at one time of a drive."""

    t_s: float
    T_world_ego: Float64[np.ndarray, "4 4"]
    twist_ego: Float64[np.ndarray, "6"]
    """Velocity (m/s) of the ego frame's origin, then turn rate (rad/s), in the ego axes.

    In curves the velocity has a lateral component, because the heading is that of the chord between the
    axles.
    """
    acceleration_ego_mps2: Float64[np.ndarray, "3"]
    """Acceleration: longitudinal from the engine and the brakes, lateral from the curve, without gravity."""
    actors: list[ActorState]
    """All road users that move or could move, without the ego vehicle."""
    lights: Int[np.ndarray, "Z"]
    """`LightState` of each of the town's stop zones."""


class ExpertDrive:
    """One drive of the expert in one town: a route and the moments along it.

    `state` is the present traffic.

    Args:
        traffic: the town's traffic. Its seed also decides the route.
        seconds: the duration of the drive, s, so that the route is long enough and turns within it.
        steering_noise: standard deviation, rad, of the occasional steering disturbance (.02 pushes the
            vehicle some decimetres off the middle of its lane). The expert steers back. 0: no disturbance.

    Raises:
        InputError: the noise is negative.
    """

    def __init__(self, traffic: Traffic, seconds: float, steering_noise: float = 0.0) -> None:
        if not steering_noise >= 0:
            raise InputError(f"the steering noise must be at least 0 rad, got {steering_noise:g}")
        self._traffic = traffic
        self._planned = plan_route(traffic.lanes, traffic.starts, traffic.seed, seconds)
        first, start_m = self._planned.lanes[:1], np.array([self._planned.start_m])
        ego = ego_vehicle(traffic.lanes, first, start_m)
        # Run the traffic until the ego vehicle drives and the random initial state has dissolved
        self.state = traffic.start(ego, self._planned.lanes)
        while not self._is_settled():
            self.state = traffic.step(self.state, MAX_STEP_S)
        self.route, self._passed = self._remaining(), self.state.route_passed
        self._steering_noise, self._deviation = steering_noise, PathDeviation()
        self._rng = np.random.default_rng((traffic.seed, 4))

    def snapshots(self, count: int, dt_s: float) -> Iterator[DriveSnapshot]:
        """Yield `count` moments of the drive, `dt_s` apart."""
        # The fewest equal steps that are not longer than `MAX_STEP_S`; the small number absorbs rounding
        steps = max(1, int(np.ceil(dt_s / MAX_STEP_S - 1e-9)))
        for index in range(count):
            if index:
                for _ in range(steps):
                    self.step(dt_s / steps)
            yield self._snapshot(index * dt_s)

    def step(self, dt_s: float) -> None:
        """Drive on for at most `MAX_STEP_S`."""
        self.state = self._traffic.step(self.state, dt_s)
        if self._steering_noise > 0:
            speed, wheelbase = (float(x[0]) for x in (self._ego.speed_mps, self._ego.wheelbase_m))
            self._deviation = step_deviation(
                self._deviation, speed, wheelbase, self._steering_noise, dt_s, self._rng
            )

    def poses(self) -> Poses:
        """Return the poses of all vehicles of `state`, with the steering disturbance applied to the ego
        vehicle."""
        poses, ego = self._traffic.poses(self.state), self._ego
        # The planned pose of the rear axle, shifted and turned by the deviation in the frame of the path
        T_world_ego = poses.axle_frame() @ T_path_ego(self._deviation)
        to_centre_ego = [float(ego.axle_to_centre_m[0]), 0.0, 0.5 * ego.size_lwh[0, 2], 1.0]
        poses.axle_xyz[0], poses.forward[0] = T_world_ego[:3, 3], T_world_ego[:3, 0]
        poses.centre_m[0] = T_world_ego[:3] @ to_centre_ego
        return poses

    def driven_commands(self) -> list[Command]:
        """Return the commands at the forks that were passed since the drive began."""
        return self.route.commands_on(self._traffic.lanes, 0, self.state.route_passed - self._passed)

    @property
    def _ego(self) -> Vehicles:
        return self.state.vehicles.rows(slice(1))

    def _is_settled(self) -> bool:
        moving = self.state.vehicles.speed_mps[0] > MOVING_MPS
        return self.state.time_s > (SETTLE_S if moving else MAX_SETTLE_S)

    def _remaining(self) -> Route:
        """Return the route from the present position of the ego vehicle."""
        # The route is measured at the rear axle, s_m at the box centre
        axle_m = float(self.state.vehicles.s_m[0] - self.state.vehicles.axle_to_centre_m[0])
        to_come = slice(self.state.route_passed, None)
        entered = self._planned.entered[to_come].copy()
        entered[0] = self._planned.lanes[to_come][0] if self._is_on_route() else entered[0]
        return Route(self._planned.lanes[to_come], max(0.0, axle_m), entered)

    def _is_on_route(self) -> bool:
        return bool(self.state.vehicles.lane[0] == self._planned.lanes[self.state.route_passed])

    def _snapshot(self, t_s: float) -> DriveSnapshot:
        ego = self._ego
        T_world_ego = vehicle_poses(self._traffic.lanes, ego).axle_frame() @ T_path_ego(self._deviation)
        twist = ego_twist(self._traffic.lanes, ego, T_world_ego, self._deviation)
        return DriveSnapshot(
            t_s=t_s,
            T_world_ego=T_world_ego,
            twist_ego=twist,
            # In a curve, the lateral acceleration is speed times turn rate
            acceleration_ego_mps2=np.array([float(ego.acceleration_mps2[0]), twist[0] * twist[5], 0.0]),
            actors=self._traffic.actors(self.state),
            lights=self._traffic.zone_lights(self.state.time_s),
        )


def ego_twist(
    lanes: LaneGraph, ego: Vehicles, T_world_ego: Float64[np.ndarray, "4 4"], deviation: PathDeviation
) -> Float64[np.ndarray, "6"]:
    """Return the motion of a vehicle's ego frame in its own axes: m/s, then rad/s. It is 0 while it stands.

    Args:
        lanes: the town's lanes.
        ego: one vehicle.
        T_world_ego: pose of its ego frame.
        deviation: of the ego frame from the vehicle's path.
    """
    half_m = 0.5 * MOTION_S * float(ego.speed_mps[0])
    if half_m == 0:
        return np.zeros(6)
    # Central difference over `MOTION_S`: poses half of it earlier and later at the present speed
    paths = zip(motion(lanes, ego), (-half_m, half_m), strict=True)
    before, after = (poses.axle_frame() @ T_path_ego(deviation.moved(moved_m)) for poses, moved_m in paths)
    # Displacement in the axes of the ego frame now; rotation as a vector, both divided by the time
    moved_ego = T_world_ego[:3, :3].T @ (after[:3, 3] - before[:3, 3])
    turned = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec()
    return np.concatenate([moved_ego, turned]) / MOTION_S


def plan_route(lanes: LaneGraph, starts: StartPoints, seed: int, seconds: float) -> Route:
    """Plan the route of a drive. It depends on the arguments alone."""
    rng = np.random.default_rng((seed, 3))
    # Long enough at the highest limit of the town for the time to settle and the whole drive
    max_length_m = lanes.limit_mps.max() * (seconds + MAX_SETTLE_S) + ROUTE_MARGIN_M
    return draw_route(lanes, starts, rng, max_length_m, SETTLE_S, SETTLE_S + seconds)


def T_path_ego(deviation: PathDeviation) -> Float64[np.ndarray, "4 4"]:
    """Return the pose of the ego frame in the frame of the path."""
    T, cos, sin = np.eye(4), np.cos(deviation.yaw_rad), np.sin(deviation.yaw_rad)
    T[:2, :2], T[1, 3] = [[cos, -sin], [sin, cos]], deviation.lateral_m
    return T
