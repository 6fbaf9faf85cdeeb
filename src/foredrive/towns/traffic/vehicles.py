"""Vehicles on lanes: their properties, their positions along their paths, and their poses."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.driving.car_following import SLOWING_TIME_S
from foredrive.towns.traffic.centrelines import SLOWING_MPS2
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.slots import Slots

BEHIND = 4
AHEAD = 11
CLEAR_OF_LANE = 0.64
"""Fraction of a lane change after which the old lane is free for others. Three quarters of the lateral shift
are done there."""
CHANGE_LATERAL_MPS2 = 2.5
"""Maximum lateral acceleration in a lane change of a given length, m/s². It limits the speed."""
MOTION_S = 0.05
"""Time over which velocities are taken, s. Over less time the sampling of the centrelines would be
visible."""
WINDOW = BEHIND + 1 + AHEAD
"""Number of lanes of its path that a vehicle knows: some behind (its rear may still be there), the current
one, and some ahead."""


@dataclass(frozen=True)
class Vehicles(Slots):
    """N vehicle slots."""

    category: Int[np.ndarray, "N"]
    size_lwh: Float64[np.ndarray, "N 3"]
    wheelbase_m: Float64[np.ndarray, "N"]
    axle_to_centre_m: Float64[np.ndarray, "N"]
    """Distance from the rear axle forward to the centre of the box, m."""
    lateral_m: Float64[np.ndarray, "N"]
    """Lateral offset of the whole path, m, positive to the left of the centreline."""
    top_speed_mps: Float64[np.ndarray, "N"]
    speed_factor: Float64[np.ndarray, "N"]
    """Factor on the driving speed."""
    time_gap_s: Float64[np.ndarray, "N"]
    accel_mps2: Float64[np.ndarray, "N"]
    decel_mps2: Float64[np.ndarray, "N"]
    path: Int[np.ndarray, "N 16"]
    """Lanes of the path: behind, current (column `BEHIND`) and ahead; -1 for none."""
    s_m: Float64[np.ndarray, "N"]
    """Arc length of the box centre on the current lane, m."""
    speed_mps: Float64[np.ndarray, "N"]
    acceleration_mps2: Float64[np.ndarray, "N"]
    granted: Int[np.ndarray, "N"]
    """Number of lanes ahead for which right of way has been granted."""
    requested_s: Float64[np.ndarray, "N"]
    """Time since which right of way has been requested, s; infinite without a request."""
    rank: Float64[np.ndarray, "N"]
    """Time at which right of way was granted, s. In a junction the lower rank goes first."""
    has_stopped: Bool[np.ndarray, "N"]
    """Whether the vehicle has stopped at the line ahead of it."""
    shift_m: Float64[np.ndarray, "N"]
    """Lateral position at which the latest lane change began, m, positive to the left of the path; 0 before
    the first lane change."""
    change_length_m: Float64[np.ndarray, "N"]
    changed_m: Float64[np.ndarray, "N"]
    """Distance of the rear axle into its lane change, m. It keeps growing after the end of the change."""

    @property
    def lane(self) -> Int[np.ndarray, "N"]:
        """Return the lane of each box centre."""
        return self.path[:, BEHIND]

    @property
    def front_m(self) -> Float64[np.ndarray, "N"]:
        """Return the arc length of the front bumper from the start of `lane`, m."""
        return self.s_m + 0.5 * self.size_lwh[:, 0]

    @property
    def rear_m(self) -> Float64[np.ndarray, "N"]:
        """Return the arc length of the rear bumper from the start of `lane`, m."""
        return self.s_m - 0.5 * self.size_lwh[:, 0]

    @property
    def beside(self) -> Int[np.ndarray, "N"]:
        """Return the side of the path on which the lane lies that a vehicle has not left yet: 1 left, -1
        right, 0 none."""
        # The old lane lies on the side from which the change began
        return np.where(self.to_clear_m > 0, np.sign(self.shift_m), 0.0).astype(np.int64)

    @property
    def to_clear_m(self) -> Float64[np.ndarray, "N"]:
        """Return the distance to drive until the old lane of a lane change is free, m."""
        # Distance to drive until the rear axle has done the share after which the old lane is free
        to_go = CLEAR_OF_LANE * self.change_length_m - self.changed_m
        return np.where(self.shift_m != 0, np.maximum(to_go, 0.0), 0.0)

    @property
    def change_max_mps(self) -> Float64[np.ndarray, "N"]:
        """Return the maximum speed in the present lane change, given its length, m/s; infinite without one.

        The quintic of `offset_m` has its maximum curvature, 10 / √3 shift / length², at (3 - √3) / 6 of its
        length.
        """
        curved = np.where(self.changed_m < self.change_length_m, np.abs(self.shift_m), 0.0)
        # Maximum curvature of the quintic; v² κ must not exceed the lateral acceleration
        curvature = 10 / np.sqrt(3) * curved / self.change_length_m**2
        return np.sqrt(CHANGE_LATERAL_MPS2 / np.maximum(curvature, 1e-9))

    def offset_m(self, ahead_m: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
        """Return the lateral offset from the path, m to the left, of a point ahead of the rear axle.

        Lane changes follow the quintic with zero lateral speed and acceleration at both ends (Takahashi et
        al. 1989, with fixed ends). It is a function of distance instead of time, so that a standing vehicle
        does not slide.
        """
        x = np.clip((self.changed_m + ahead_m) / self.change_length_m, 0.0, 1.0)
        return self.lateral_m + self.shift_m * (1 - x**3 * (10 - 15 * x + 6 * x**2))

    def moved(self, distance_m: Float64[np.ndarray, "N"]) -> "Vehicles":
        """Return the vehicles moved forward by a distance (m)."""
        return dataclasses.replace(self, s_m=self.s_m + distance_m, changed_m=self.changed_m + distance_m)


@dataclass(frozen=True)
class Poses:
    """Poses of N rigid bodies on the ground, world frame."""

    axle_xyz: Float64[np.ndarray, "N 3"]
    """Ground point below the rear axle, m."""
    centre_m: Float64[np.ndarray, "N 3"]
    """Box centre, m."""
    forward: Float64[np.ndarray, "N 3"]
    """Unit heading along the slope of the ground."""

    @property
    def yaw(self) -> Float64[np.ndarray, "N"]:
        """Return the heading about z, rad."""
        return np.arctan2(self.forward[:, 1], self.forward[:, 0])

    @property
    def pitch(self) -> Float64[np.ndarray, "N"]:
        """Return the pitch about the left axis, rad, positive with the nose down."""
        return -np.arcsin(np.clip(self.forward[:, 2], -1, 1))

    def axle_frame(self, row: int = 0) -> Float64[np.ndarray, "4 4"]:
        """Return the pose of a body's ego frame: on the road below its rear axle, x along the slope."""
        forward = self.forward[row]
        # Left is horizontal: the body does not roll
        left = np.array([-forward[1], forward[0], 0.0]) / np.hypot(forward[0], forward[1])
        T = np.eye(4)
        # Columns of the rotation are the ego axes in the world: x forward, y left, z up
        T[:3, :3] = np.stack([forward, left, np.cross(forward, left)], axis=1)
        T[:3, 3] = self.axle_xyz[row]
        return T


def empty_slots(count: int) -> Vehicles:
    """Return `count` empty slots."""
    values = {
        field.name: np.zeros((count, 3)) if field.name == "size_lwh" else np.zeros(count)
        for field in dataclasses.fields(Vehicles)
    }
    for name in ("active", "has_stopped"):
        values[name] = np.zeros(count, dtype=np.bool_)
    for name in ("track_id", "category", "style", "granted"):
        values[name] = np.zeros(count, dtype=np.int64)
    for name in ("wheelbase_m", "accel_mps2", "decel_mps2", "speed_factor", "change_length_m"):
        values[name] = np.ones(count)
    values["path"] = np.full((count, WINDOW), -1)
    values["requested_s"] = np.full(count, np.inf)
    return Vehicles(**values)


def path_starts(graph: LaneGraph, path: Int[np.ndarray, "N W"]) -> Float64[np.ndarray, "N W"]:
    """Return the arc length at which each lane of a path starts, m from the start of the current lane."""
    # Unknown lanes ahead are infinitely long, so nothing beyond them is ever near
    length = np.where(path >= 0, graph.length_m[path], np.inf)
    length[:, :BEHIND] = np.where(path[:, :BEHIND] >= 0, length[:, :BEHIND], 0.0)
    start = np.zeros(path.shape)
    # Ahead: sum of the lengths from the current lane on; behind: negative sums backwards
    start[:, BEHIND + 1 :] = np.cumsum(length[:, BEHIND:-1], axis=1)
    start[:, :BEHIND] = -np.cumsum(length[:, BEHIND - 1 :: -1], axis=1)[:, ::-1]
    return start


def points_on_paths(
    graph: LaneGraph,
    path: Int[np.ndarray, "N W"],
    starts_m: Float64[np.ndarray, "N W"],
    s_m: Float64[np.ndarray, "N"],
) -> Float64[np.ndarray, "N 3"]:
    """Return points on paths at arc lengths from the start of the current lane.

    Paths continue straight beyond their ends.
    """
    # The last lane that begins at or before the arc length; the first known lane if none does
    column = np.where(path >= 0, starts_m <= s_m[:, None], False)
    column = np.where(
        column.any(1), WINDOW - 1 - np.argmax(column[:, ::-1], axis=1), np.argmax(path >= 0, axis=1)
    )
    rows = np.arange(len(path))
    lane, local = path[rows, column], s_m - starts_m[rows, column]
    inside = np.clip(local, 0, graph.length_m[lane])
    point = graph.position(lane, inside)
    # Beyond the ends of the path: straight on along the last or first segment
    beyond = local - inside
    if np.abs(beyond).max(initial=0.0) > 0:
        end = np.where(beyond > 0, graph.first[lane] + graph.count[lane] - 2, graph.first[lane])
        ahead = graph.xyz[end + 1] - graph.xyz[end]
        point = point + beyond[:, None] * ahead / np.linalg.norm(ahead, axis=1, keepdims=True).clip(1e-9)
    return point


def vehicle_poses(graph: LaneGraph, vehicles: Vehicles) -> Poses:
    """Return the poses of vehicles whose two axles both lie on the path, as in real vehicles.

    Slots that are not active are at the origin.
    """
    live = np.flatnonzero(vehicles.active)
    path = vehicles.path[live]
    starts = path_starts(graph, path)
    # s_m is the box centre, so the rear axle lies behind it
    axle_s = vehicles.s_m[live] - vehicles.axle_to_centre_m[live]
    rear = points_on_paths(graph, path, starts, axle_s)
    front = points_on_paths(graph, path, starts, axle_s + vehicles.wheelbase_m[live])
    # Lateral offsets of both axles, across the chord between their points on the centreline
    left = _left_of(front - rear)
    axle = rear + vehicles.offset_m(np.zeros(len(vehicles.active)))[live, None] * left
    # The body's heading is that of the chord between the axles
    forward = front + vehicles.offset_m(vehicles.wheelbase_m)[live, None] * left - axle
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    left = _left_of(forward)
    # From the axle forward to the middle of the box, and up by half its height
    centre = axle + vehicles.axle_to_centre_m[live, None] * forward
    centre += 0.5 * vehicles.size_lwh[live, 2:] * _up_of(forward, left)
    out = [np.zeros((len(vehicles.active), 3)) for _ in range(3)]
    for whole, part in zip(out, (axle, centre, forward), strict=True):
        whole[live] = part
    return Poses(*out)


def motion(graph: LaneGraph, vehicles: Vehicles) -> tuple[Poses, Poses]:
    """Return the poses half of `MOTION_S` earlier and later at the present speeds.

    Their difference gives the motion of the bodies.
    """
    half_m = 0.5 * MOTION_S * vehicles.speed_mps
    return vehicle_poses(graph, vehicles.moved(-half_m)), vehicle_poses(graph, vehicles.moved(half_m))


def _left_of(forward: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    left = np.stack([-forward[:, 1], forward[:, 0], np.zeros(len(forward))], axis=1)
    return left / np.linalg.norm(left, axis=1, keepdims=True)


def _up_of(
    forward: Float64[np.ndarray, "n 3"], left: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return forward × left, where left is horizontal.

    NumPy's cross product is much slower for a few vectors.
    """
    (fx, fy, fz), (lx, ly, _) = forward.T, left.T
    return np.stack([-fz * ly, fz * lx, fx * ly - fy * lx], axis=1)


def desired_speed(
    graph: LaneGraph, vehicles: Vehicles, starts_m: Float64[np.ndarray, "N W"]
) -> Float64[np.ndarray, "N"]:
    """Return the wanted speed, m/s: the speed profile at the vehicle, lowered in time for the lanes ahead.

    Drivers look `SLOWING_TIME_S` ahead, because they reach the speed that they want now only after this time.
    """
    # Point where the vehicle will be when it has adapted its speed
    soon_m = vehicles.s_m + SLOWING_TIME_S * vehicles.speed_mps
    here = np.minimum(graph.speed(vehicles.lane, vehicles.s_m), graph.speed(vehicles.lane, soon_m))
    ahead = vehicles.path[:, BEHIND + 1 :]
    entry = np.where(ahead >= 0, graph.speed_mps[graph.first[ahead]], np.inf)
    # Way to the start of each lane ahead; v² = v_entry² + 2 b s slows down in time
    to_go = starts_m[:, BEHIND + 1 :] - soon_m[:, None]
    in_time = np.sqrt(entry**2 + 2 * SLOWING_MPS2 * np.maximum(to_go, 0.0)).min(axis=1)
    wanted = np.minimum(vehicles.top_speed_mps, vehicles.speed_factor * np.minimum(here, in_time))
    return np.minimum(wanted, vehicles.change_max_mps)
