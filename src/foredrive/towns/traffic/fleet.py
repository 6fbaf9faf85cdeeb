"""The fleet: kinds of vehicles with their shares, sizes and drivers, and the points where new ones may
start."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int

from foredrive.data.log_writer import EGO_VEHICLE
from foredrive.scene import Category
from foredrive.towns.traffic.lane_graph import LaneGraph
from foredrive.towns.traffic.vehicles import BEHIND, WINDOW, Vehicles, empty_slots

LARGE_RADIUS_M = 9.0
START_SPACING_M = 2.0
CLEAR_OF_END_M = 8.0
"""Minimum distance of new vehicles from the end of their lane, m, so that they can stop at its line."""
BRAKING_MPS2 = 2.0


@dataclass(frozen=True)
class VehicleKind:
    """A kind of vehicle. Sizes and top speeds are drawn uniformly from their ranges."""

    category: Category
    share: float
    min_lwh: tuple[float, float, float]
    max_lwh: tuple[float, float, float]
    accel_mps2: float
    decel_mps2: float
    wheelbase: float = 0.6
    """Wheelbase as a fraction of the length."""
    top_speed_mps: tuple[float, float] = (36.0, 44.0)
    is_large: bool = False
    """Whether it keeps to lanes without tight curves."""
    right_m: float = 0.0
    """Offset to the right of the centreline, m."""


HEAVY_MPS = (22.0, 24.0)
KINDS = (
    VehicleKind(Category.CAR, 0.64, (3.9, 1.7, 1.4), (4.9, 1.9, 1.7), 1.6, 1.9),
    VehicleKind(Category.CAR, 0.12, (5.1, 1.95, 2.0), (5.9, 2.05, 2.5), 1.4, 1.8),
    VehicleKind(
        Category.TRUCK,
        0.07,
        (6.5, 2.3, 2.8),
        (8.0, 2.45, 3.3),
        1.0,
        1.6,
        0.55,
        HEAVY_MPS,
        is_large=True,
    ),
    VehicleKind(
        Category.BUS,
        0.04,
        (9.0, 2.4, 2.9),
        (10.5, 2.5, 3.2),
        1.0,
        1.5,
        0.52,
        HEAVY_MPS,
        is_large=True,
    ),
    VehicleKind(Category.MOTORCYCLE, 0.06, (2.0, 0.7, 1.4), (2.2, 0.85, 1.6), 2.0, 2.0, 0.65),
    VehicleKind(
        Category.BICYCLE, 0.07, (1.65, 0.55, 1.6), (1.85, 0.7, 1.8), 1.0, 1.8, 0.6, (4.5, 7.0), right_m=0.9
    ),
)
"""Cars, vans, trucks, buses, motorcycles and bicycles with their riders. Accelerations are those of city
drivers (Treiber & Kesting 2013, table 11.2 gives 1.0 and 1.5 m/s²), slightly higher for cars."""


def draw_fleet(
    rng: np.random.Generator,
    track_ids: Int[np.ndarray, "k"],
    for_large: Bool[np.ndarray, "k"],
    for_bicycles: Bool[np.ndarray, "k"],
) -> Vehicles:
    """Draw k vehicles with their drivers, not yet placed.

    Large ones and bicycles appear only where they are allowed.
    """
    count = len(track_ids)
    share = np.array([kind.share for kind in KINDS])
    large = np.array([kind.is_large for kind in KINDS])
    bicycle = np.array([kind.category == Category.BICYCLE for kind in KINDS])
    # A kind's weight is 0 where it is not allowed; draw from the cumulated weights
    weight = share * (for_large[:, None] | ~large) * (for_bicycles[:, None] | ~bicycle)
    cumulated = np.cumsum(weight, axis=1)
    kinds = np.argmax(cumulated > rng.random((count, 1)) * cumulated[:, -1:], axis=1)
    low = np.array([[*kind.min_lwh, kind.top_speed_mps[0]] for kind in KINDS])[kinds]
    high = np.array([[*kind.max_lwh, kind.top_speed_mps[1]] for kind in KINDS])[kinds]
    # One random number for length, width and height, another for the top speed
    u = np.repeat(rng.random((count, 2)), [3, 1], axis=1)  # long vehicles are also wide and high
    drawn = low + u * (high - low)
    wheelbase = np.array([kind.wheelbase for kind in KINDS])[kinds] * drawn[:, 0]
    right_m = np.array([kind.right_m for kind in KINDS])[kinds]
    empty = empty_slots(count)
    return Vehicles(
        **{
            **vars(empty),
            "active": np.ones(count, dtype=np.bool_),
            "track_id": track_ids,
            "category": np.array([int(kind.category) for kind in KINDS])[kinds],
            "style": rng.integers(0, 2**31, count),
            "size_lwh": drawn[:, :3],
            "wheelbase_m": wheelbase,
            "axle_to_centre_m": 0.5 * wheelbase,
            "lateral_m": np.clip(rng.normal(0.0, 0.1, count), -0.2, 0.2) - right_m,
            "top_speed_mps": drawn[:, 3],
            "speed_factor": rng.uniform(0.82, 1.0, count),
            "time_gap_s": rng.uniform(1.0, 1.6, count),
            "accel_mps2": np.array([kind.accel_mps2 for kind in KINDS])[kinds]
            * rng.uniform(0.85, 1.15, count),
            "decel_mps2": np.array([kind.decel_mps2 for kind in KINDS])[kinds],
        }
    )


def is_large(vehicles: Vehicles) -> Bool[np.ndarray, "N"]:
    """Return which vehicles keep to lanes without curves tighter than `LARGE_RADIUS_M`."""
    large = {kind.category for kind in KINDS if kind.is_large}
    return np.array([Category(c) in large for c in range(len(Category))])[vehicles.category]


@dataclass(frozen=True)
class StartPoints:
    """Points of lanes outside junctions where a vehicle may start."""

    lane: Int[np.ndarray, "K"]
    s_m: Float64[np.ndarray, "K"]
    xyz: Float64[np.ndarray, "K 3"]
    forward: Float64[np.ndarray, "K 3"]


def find_start_points(graph: LaneGraph) -> StartPoints:
    """Find all starts of a town, `START_SPACING_M` apart."""
    lanes, along = [], []
    # Only lanes outside junctions and before no junction that others cross
    for lane in np.flatnonzero((graph.junction < 0) & ~graph.contested):
        s = np.arange(CLEAR_OF_END_M, graph.length_m[lane] - CLEAR_OF_END_M, START_SPACING_M)
        lanes.append(np.full(len(s), lane))
        along.append(s)
    at_lane, at_m = np.concatenate(lanes), np.concatenate(along)
    xyz = graph.position(at_lane, at_m)
    # Heading from a point 1 m further on
    ahead = graph.position(at_lane, at_m + 1.0) - xyz
    return StartPoints(at_lane, at_m, xyz, ahead / np.linalg.norm(ahead, axis=1, keepdims=True))


def place_vehicles(
    graph: LaneGraph, vehicles: Vehicles, lane: Int[np.ndarray, "k"], s_m: Float64[np.ndarray, "k"]
) -> Vehicles:
    """Place vehicles on lanes at the driving speed, but slow enough to stop at the end of the lane.

    Of the path only the lanes behind and the current lane are set.
    """
    path = np.full((len(lane), WINDOW), -1)
    # The path behind follows the first predecessors; the lanes ahead are drawn later
    path[:, BEHIND] = lane
    for column in range(BEHIND - 1, -1, -1):
        path[:, column] = np.where(path[:, column + 1] >= 0, graph.predecessors[path[:, column + 1], 0], -1)
    # Room from the front bumper to the end, less a margin of 2 m
    to_end = np.maximum(graph.length_m[lane] - s_m - 0.5 * vehicles.size_lwh[:, 0] - 2.0, 0.0)
    speed = vehicles.speed_factor * np.minimum(graph.speed(lane, s_m), vehicles.top_speed_mps)
    # v² = 2 b s: it must be able to stop at the end of the lane
    speed = np.minimum(speed, np.sqrt(2 * BRAKING_MPS2 * to_end))
    return Vehicles(**{**vars(vehicles), "path": path, "s_m": s_m.astype(np.float64), "speed_mps": speed})


def ego_vehicle(graph: LaneGraph, lane: Int[np.ndarray, "1"], s_m: Float64[np.ndarray, "1"]) -> Vehicles:
    """Return the recording vehicle with a calm driver, on a lane."""
    driver = dataclasses.replace(
        empty_slots(1),
        active=np.array([True]),
        category=np.array([int(Category.CAR)]),
        size_lwh=np.array([[EGO_VEHICLE.length, EGO_VEHICLE.width, EGO_VEHICLE.height]]),
        wheelbase_m=np.array([EGO_VEHICLE.wheel_base]),
        axle_to_centre_m=np.array([EGO_VEHICLE.rear_axle_to_center_longitudinal]),
        top_speed_mps=np.array([30.0]),
        speed_factor=np.array([0.97]),
        time_gap_s=np.array([1.4]),
        accel_mps2=np.array([1.5]),
        decel_mps2=np.array([1.8]),
    )
    return place_vehicles(graph, driver, lane, s_m)
