"""What the score is computed from: the ego vehicle, the road users and the roads, at steps of 0.1 s.

Source of the whole room: public repository autonomousvision/navsim at 0a380a9 (v2),
`planner/pdm_planner/scoring`; Cao et al., "Pseudo-Simulation for Autonomous Driving", CoRL 2025.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Bool, Float64

from foredrive.errors import InputError
from foredrive.scene.road_map import Outline, RoadMap

STEP_S = 0.1
"""Time between two steps, s."""


@dataclass(frozen=True)
class EgoBody:
    """Outline of the ego vehicle. The default is nuPlan's Chrysler Pacifica."""

    length_m: float = 5.176
    width_m: float = 2.297
    axle_to_centre_m: float = 1.461


@dataclass(frozen=True, eq=False)
class EgoMotion:
    """The ego vehicle at T steps, the first at now, in the world frame.

    Raises:
        InputError: a number is not finite.
    """

    xy_m: Float64[np.ndarray, "T 2"]
    """Rear axle."""
    yaw_rad: Float64[np.ndarray, "T"]
    speed_mps: Float64[np.ndarray, "T"]
    acceleration_mps2: Float64[np.ndarray, "T"]
    """Along the heading, at the rear axle."""
    yaw_rate_radps: Float64[np.ndarray, "T"]

    def __post_init__(self) -> None:
        columns = (*self.xy_m.T, self.yaw_rad, self.speed_mps, self.acceleration_mps2, self.yaw_rate_radps)
        if not all(np.isfinite(column).all() for column in columns):
            raise InputError("an ego motion must be finite")

    def steps(self, which: slice) -> "EgoMotion":
        """Return some of the steps."""
        return EgoMotion(
            self.xy_m[which],
            self.yaw_rad[which],
            self.speed_mps[which],
            self.acceleration_mps2[which],
            self.yaw_rate_radps[which],
        )

    def after(self, before: "EgoMotion") -> "EgoMotion":
        """Return this motion behind an earlier one."""
        return EgoMotion(
            np.concatenate([before.xy_m, self.xy_m]),
            np.concatenate([before.yaw_rad, self.yaw_rad]),
            np.concatenate([before.speed_mps, self.speed_mps]),
            np.concatenate([before.acceleration_mps2, self.acceleration_mps2]),
            np.concatenate([before.yaw_rate_radps, self.yaw_rate_radps]),
        )

    def centres(self, body: EgoBody) -> Float64[np.ndarray, "T 2"]:
        """Return the middle of the body at each step."""
        forward = np.stack([np.cos(self.yaw_rad), np.sin(self.yaw_rad)], axis=1)
        return np.asarray(self.xy_m + body.axle_to_centre_m * forward)

    def corners(self, body: EgoBody) -> Float64[np.ndarray, "T 4 2"]:
        """Return the corners of the body: front left, rear left, rear right, front right."""
        half = 0.5 * np.array([body.length_m, body.width_m])
        return rectangles(self.centres(body), self.yaw_rad, np.broadcast_to(half, (len(self.yaw_rad), 2)))


def rectangles(
    centre_m: Float64[np.ndarray, "N 2"],
    yaw_rad: Float64[np.ndarray, "N"],
    half_lw: Float64[np.ndarray, "N 2"],
) -> Float64[np.ndarray, "N 4 2"]:
    """Return the corners of rectangles: front left, rear left, rear right, front right."""
    signs = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    local = signs * half_lw[:, None]
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    turned = np.stack(
        [cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]], -1
    )
    return np.asarray(centre_m[:, None] + turned)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """M road users and objects at T steps, and the lanes that are closed by red lights."""

    centre_m: Float64[np.ndarray, "T M 2"]
    yaw_rad: Float64[np.ndarray, "T M"]
    half_lw: Float64[np.ndarray, "M 2"]
    speed_mps: Float64[np.ndarray, "T M"]
    present: Bool[np.ndarray, "T M"]
    moves_by_itself: Bool[np.ndarray, "M"]
    """Vehicles, cyclists and pedestrians. A collision with anything else costs half."""
    red_m: tuple[tuple[Outline, ...], ...] = ()
    """For each step the outlines of lanes that a red light closes. Empty: no light is known."""

    @cached_property
    def outlines(self) -> list[list[shapely.Polygon | None]]:
        """Return the outline of each object at each step; None where it is absent."""
        return [
            [
                shapely.Polygon(corners) if is_present else None
                for corners, is_present in zip(rectangles(centre, yaw, self.half_lw), present, strict=True)
            ]
            for centre, yaw, present in zip(self.centre_m, self.yaw_rad, self.present, strict=True)
        ]

    def stopped(self, row: int, slowest_mps: float) -> bool:
        """Return whether an object stands when it is first seen: the devkit keeps its first state."""
        seen = np.flatnonzero(self.present[:, row])
        return len(seen) == 0 or float(self.speed_mps[seen[0], row]) <= slowest_mps


class Roads:
    """Areas of a map, ready for points in them.

    Args:
        road_map: the map.
    """

    def __init__(self, road_map: RoadMap) -> None:
        self.lanes = [_area(outline) for outline in road_map.lanes]
        self.on_route = list(road_map.on_route)
        self.drivable = shapely.union_all([_area(outline) for outline in road_map.drivable])
        self.intersections = shapely.union_all([_area(outline) for outline in road_map.intersections])
        self.centreline = shapely.LineString(road_map.centreline)
        shapely.prepare([*self.lanes, self.drivable, self.intersections])

    def in_intersection(self, xy_m: Float64[np.ndarray, "N 2"]) -> Bool[np.ndarray, "N"]:
        """Return which points are in an intersection."""
        return np.asarray(shapely.contains_xy(self.intersections, *xy_m.T))


def _area(outline: Outline) -> shapely.Geometry:
    return shapely.make_valid(shapely.Polygon(outline))
