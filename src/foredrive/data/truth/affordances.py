"""Reading of affordances: the light of the path, and the road users in it over time, from a log alone.

Logs of towns have the states of lights by the lanes behind their stop lines, so nothing else is recorded for
this. Other logs have no lights, and their path is the driven one.
"""

import functools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from py123d.api import MapAPI
from py123d.datatypes import Lane, MapLayer, StopZone, StopZoneType, TrafficLightStatus
from torch import Tensor

from foredrive.data.arrow_files import reading
from foredrive.data.boxes import read_boxes, read_tracks
from foredrive.data.commands import route_at
from foredrive.data.logs import Log
from foredrive.data.recorded import read_signal_lamps, read_traffic_lights, read_visibility
from foredrive.data.truth.agent_futures import annotated_at, read_futures
from foredrive.geometry.path_frame import along_path, path_headings
from foredrive.geometry.path_occupancy import cells_covered
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.scene import Boxes
from foredrive.scene.affordances import (
    CELL_M,
    CELLS,
    HALF_WIDTH_M,
    LATER_DT_S,
    LEAD_RANGE_M,
    LIGHT_RANGE_M,
    TIMES,
    Affordances,
)
from foredrive.scene.boxes import VEHICLES
from foredrive.scene.traffic_light import LightState

POINTS = 72
"""Points of the path, a metre apart."""
PASSED_M = 4.4
"""A light counts until the front bumper is this far beyond its line: until then the point whose crossing is
judged, near the rear axle, has not crossed it (`driving.lane_rules`)."""
BESIDE_M = 1.75
ALIGNED_COS = 0.5
LEVEL_M = 2.5
"""A stop line is on the path if its lane begins at most this far beside it, at most 60° turned, at its
height."""
STOP_LINE_M = 3.0
"""Length of a stop line across its lane."""
FOLLOWS_M, FOLLOWS_SLOPE = 2.0, 0.15
"""A road user behind the rear axle follows the ego vehicle if it is at most this far beside its axis: more
the further behind it is."""
STATE_OF_STATUS = {
    TrafficLightStatus.RED: LightState.RED,
    TrafficLightStatus.YELLOW: LightState.YELLOW,
    TrafficLightStatus.GREEN: LightState.GREEN,
}


class PathAhead(NamedTuple):
    """The path ahead in the ego frame."""

    xy: Float[Tensor, "R 2"]
    z: Float64[np.ndarray, "R"]
    valid: Bool[Tensor, "R"]
    front_m: float
    """Distance along the path of the front bumper."""
    given: bool
    """True for a route that was given to the vehicle. Beyond its end there is nothing to judge."""


class _StopLines(NamedTuple):
    """Begins of the lanes behind lights or signs."""

    lane: Int64[np.ndarray, "L"]
    xyz: Float64[np.ndarray, "L 3"]
    ahead: Float64[np.ndarray, "L 3"]


def read_affordances(log: Log, frame: int) -> Affordances:
    """Read the affordances at a frame, unbatched. Values that the log lacks are marked as unknown.

    Raises:
        InputError: the route, the map, the lights or the boxes cannot be read.
    """
    path = _path(log, frame)
    light, light_m, light_known, lane = _light(log, frame, path)
    sign_m, sign_known = _sign(log, frame, path)
    lamps, lamps_known = _lamps(log, frame, lane)
    boxes = read_boxes(log, frame)
    lead, lead_m, lead_mps, lead_known = lead_of(boxes, path)
    occupied, occupied_known = _occupied(log, frame, boxes, path)
    return Affordances(
        path_xy=path.xy,
        path_valid=path.valid,
        light=torch.tensor(int(light)),
        light_m=torch.tensor(light_m),
        light_known=torch.tensor(light_known),
        lamp_xyz=lamps,
        lamp=torch.ones(len(lamps), dtype=torch.bool),
        lamps_known=torch.tensor(lamps_known and light_known),
        sign=torch.tensor(sign_m is not None),
        sign_m=torch.tensor(sign_m or 0.0),
        sign_known=torch.tensor(sign_known),
        lead=torch.tensor(lead),
        lead_m=torch.tensor(lead_m),
        lead_mps=torch.tensor(lead_mps),
        lead_known=torch.tensor(lead_known),
        occupied=occupied,
        occupied_known=occupied_known,
    )


def _path(log: Log, frame: int) -> PathAhead:
    """Return the route from beside the rear axle on, or the driven path where there is no route."""
    route = route_at(log, frame)
    centre, size = log.ego_box
    # Distance from the rear axle to the front bumper
    front_m = float(centre[0] + 0.5 * size[0])
    if route is None:
        # Without a route, the driven path from now on stands for it
        xyz = log.T_world_ego[frame:, :3, 3]
        return path_ahead(xyz, arc_lengths(xyz), 0.0, log.T_world_ego[frame], front_m, given=False)
    arc_m, xyz, progress_m = route
    return path_ahead(xyz, arc_m, progress_m, log.T_world_ego[frame], front_m)


def path_ahead(
    xyz: Float64[np.ndarray, "K 3"],
    arc_m: Float64[np.ndarray, "K"],
    progress_m: float,
    T_world_ego: Float64[np.ndarray, "4 4"],
    front_m: float,
    given: bool = True,
) -> PathAhead:
    """Return the part of a path ahead of the vehicle.

    Args:
        xyz: the whole path, world frame, m.
        arc_m: arc length of each of its points.
        progress_m: arc length of the point beside the rear axle.
        T_world_ego: pose of the vehicle.
        front_m: distance from the rear axle to the front bumper.
        given: whether it is a route that the vehicle was given.
    """
    at_m = np.arange(POINTS, dtype=np.float64)
    # Points a metre apart, up to the end of the path
    on_path = at_m <= arc_m[-1] - progress_m
    ahead = _in_frame(points_at(xyz, arc_m, progress_m + at_m), T_world_ego) * on_path[:, None]
    return PathAhead(
        torch.from_numpy(ahead[:, :2]).float(),
        ahead[:, 2],
        # A single point is no path
        torch.from_numpy(on_path & (on_path.sum() > 1)),
        front_m,
        given,
    )


def _light(log: Log, frame: int, path: PathAhead) -> tuple[LightState, float, bool, int | None]:
    """Return state and distance of the next light on the path, whether they are known, and its lane."""
    shown, lines = read_traffic_lights(log, frame), _stop_lines(log)
    if shown is None or lines is None or not path.given or not bool(path.valid.any()):
        # Lights matter on a given route only: the driven path ends where the drive does
        return LightState.NONE, 0.0, False, None
    # The nearest line on the path whose light has a known state
    for row, line_m in _on_path(lines, log, frame, path):
        lane = int(lines.lane[row])
        state = STATE_OF_STATUS.get(shown.get(lane, TrafficLightStatus.UNKNOWN))
        if state is not None:
            return state, line_m, True, lane
    return LightState.NONE, 0.0, True, None


def _sign(log: Log, frame: int, path: PathAhead) -> tuple[float | None, bool]:
    """Return the distance of the next stop sign on the path, None without one, and whether it is known."""
    lines = _sign_lines(log)
    if lines is None or not path.given or not bool(path.valid.any()):
        return None, False
    return next((line_m for _, line_m in _on_path(lines, log, frame, path)), None), True


def _on_path(lines: _StopLines, log: Log, frame: int, path: PathAhead) -> list[tuple[int, float]]:
    """Return the rows of the lines on the path with their distances from the bumper, the nearest first."""
    if not len(lines.lane):
        return []
    # Stop lines in the ego frame, then along and beside the path
    xyz = _in_ego_frame(lines.xyz, log, frame)
    along_m, left_m = along_path(torch.from_numpy(xyz[:, :2]).float(), path.xy, path.valid)
    heading = path_headings(along_m, path.xy, path.valid).double().numpy()
    # Direction of each lane behind its stop line, in the ego frame
    ahead = (lines.ahead @ log.T_world_ego[frame, :3, :3])[:, :2]
    distance_m = along_m.double().numpy() - path.front_m
    # Height of the path at the stop line, so that lines on bridges above or below do not count
    height_m = np.interp(along_m.numpy(), np.arange(POINTS), path.z)
    on_path = (
        (left_m.abs().numpy() < BESIDE_M)
        & ((heading * ahead).sum(-1) > ALIGNED_COS)
        & (np.abs(xyz[:, 2] - height_m) < LEVEL_M)
        & (distance_m > -PASSED_M)
        & (distance_m <= LIGHT_RANGE_M)
    )
    rows = sorted(np.flatnonzero(on_path).tolist(), key=distance_m.__getitem__)
    return [(row, float(distance_m[row])) for row in rows]


def read_stop_lines(log: Log, frame: int) -> list[tuple[LightState, Float64[np.ndarray, "2 2"]]]:
    """Read the state of each known light at a frame, and the ends of its lane's stop line, world xy in m.

    Raises:
        InputError: the map or the lights cannot be read.
    """
    shown, lines = read_traffic_lights(log, frame), _stop_lines(log)
    if shown is None or lines is None:
        return []
    # Across the lane, to its left
    left = np.stack([-lines.ahead[:, 1], lines.ahead[:, 0]], axis=1) * STOP_LINE_M / 2
    return [
        (state, np.stack([xyz[:2] + half, xyz[:2] - half]))
        for lane, xyz, half in zip(lines.lane.tolist(), lines.xyz, left, strict=True)
        if (state := STATE_OF_STATUS.get(shown.get(lane, TrafficLightStatus.UNKNOWN))) is not None
    ]


def _lamps(log: Log, frame: int, lane: int | None) -> tuple[Float[Tensor, "L 3"], bool]:
    """Return the places of the lamps for a lane in the ego frame, and whether they are known."""
    shown = read_signal_lamps(log, frame)
    # Without a light on the path, it is known that there are no lamps
    if shown is None or lane is None or lane not in shown:
        return torch.zeros(0, 3), shown is not None and lane is None
    return torch.from_numpy(_in_ego_frame(shown[lane], log, frame)).float(), True


@functools.lru_cache(maxsize=64)
def _stop_lines(log: Log) -> _StopLines | None:
    """Return the lanes that lights of the log guard. None without lights or map."""
    shown = read_traffic_lights(log, 0)
    with reading(log.path.folder, "its map"):
        api = log.scene.get_map_api()
        return None if shown is None or api is None else _begins(api, shown)


@functools.lru_cache(maxsize=64)
def _sign_lines(log: Log) -> _StopLines | None:
    """Return the lanes behind the stop signs of the log's map. None where it does not tell all of them."""
    with reading(log.path.folder, "its map"):
        api = log.scene.get_map_api()
        if api is None or MapLayer.STOP_ZONE not in api.get_available_map_layers():
            return None
        layer = api.get_all_map_objects_in_layer(MapLayer.STOP_ZONE)
        zones = [zone for zone in layer if isinstance(zone, StopZone)]
        # A zone of an unknown kind may be of a sign
        if any(zone.stop_zone_type is StopZoneType.UNKNOWN for zone in zones):
            return None
        signs = [zone for zone in zones if zone.stop_zone_type is StopZoneType.STOP_SIGN]
        return _begins(api, dict.fromkeys(lane for zone in signs for lane in zone.lane_ids))


def _begins(api: MapAPI, names: Iterable[int | str]) -> _StopLines:
    """Return where lanes begin, and in which direction."""
    by_name = {name: api.get_map_object_in_layer(name, MapLayer.LANE) for name in names}
    lanes = {name: lane for name, lane in by_name.items() if isinstance(lane, Lane)}
    # The first two points of a lane's centre line give its begin and direction
    starts = [np.asarray(lane.centerline_3d.array, dtype=np.float64)[:2] for lane in lanes.values()]
    two = np.array(starts).reshape(-1, 2, 3)
    ahead = two[:, 1] - two[:, 0]
    length_m = np.linalg.norm(ahead, axis=-1, keepdims=True)
    return _StopLines(np.array(list(lanes), dtype=np.int64), two[:, 0], ahead / np.maximum(length_m, 1e-9))


def lead_of(boxes: Boxes | None, path: PathAhead) -> tuple[bool, float, float, bool]:
    """Return whether a vehicle is in the path, its gap and its speed, and whether that is known.

    Args:
        boxes: unbatched, in the frame of the path. None without annotation.
        path: the path.
    """
    if boxes is None or not bool(path.valid.any()):
        return False, 0.0, 0.0, False
    vehicles = torch.isin(boxes.category, torch.tensor([int(kind) for kind in VEHICLES]))
    chosen = boxes[vehicles & boxes.valid]
    # Points all over the footprint, since the corner nearest to the path may be any
    points = _points_of(chosen)
    along_m, left_m = along_path(points.flatten(0, 1), path.xy, path.valid)
    gap_m = (along_m - path.front_m).view(points.shape[:2])
    # Vehicles within half the width of the way, from a metre behind the front bumper on
    in_way = (left_m.view(points.shape[:2]).abs() < HALF_WIDTH_M) & (gap_m > -1.0)
    nearest_m = gap_m.masked_fill(~in_way, torch.inf).amin(-1)
    if len(nearest_m) and float(nearest_m.min()) <= LEAD_RANGE_M:
        row = int(nearest_m.argmin())
        gap = float(nearest_m[row])
        direction = path_headings(torch.tensor([gap + path.front_m]), path.xy, path.valid)[0]
        # Speed of the lead vehicle along the path at its gap
        speed_mps = float((chosen.velocity[row] * direction).sum())
        return True, max(gap, 0.0), speed_mps, True
    # On the driven path, the absence of a lead vehicle is known only as far as the path reaches
    reach_m = float(path.valid.sum()) - 1.0 - path.front_m
    return False, 0.0, 0.0, path.given or reach_m >= LEAD_RANGE_M


def _occupied(
    log: Log, frame: int, boxes: Boxes | None, path: PathAhead
) -> tuple[Bool[Tensor, "T G"], Bool[Tensor, "T G"]]:
    """Return which cells of the path are occupied at which times, and where this is known."""
    tracks = read_tracks(log)
    if boxes is None or tracks is None or not bool(path.valid.any()):
        nothing = torch.zeros(TIMES, CELLS, dtype=torch.bool)
        return nothing, nothing
    future = read_futures(log, frame, TIMES - 1, LATER_DT_S)
    # Each road user now and later, in the ego frame at now
    by_user = occupied_by(
        boxes,
        torch.cat([boxes.centre[:, None, :2], future.xy], dim=1),
        torch.cat([boxes.yaw[:, None], future.yaw], dim=1),
        torch.cat([boxes.valid[:, None], future.valid], dim=1),
        path,
    )
    # A road user that no sensor shows cannot be learned: its cells are left open, not free.
    seen = torch.ones(len(boxes.yaw), dtype=torch.bool)
    if (share := read_visibility(log, frame)) is not None:
        seen = share > 0
    occupied = by_user[seen].any(0)
    # Cells that the path covers whole
    reach_m = path.front_m + CELL_M * torch.arange(1, CELLS + 1)
    inside = reach_m <= float(path.valid.sum()) - 1.0
    t_us = log.t_us[frame] + np.round(np.arange(TIMES) * LATER_DT_S * 1e6).astype(np.int64)
    annotated = torch.from_numpy(annotated_at(tracks, t_us))
    # Cells are judged at annotated times, unless only an invisible road user covers them
    judged = annotated[:, None] & inside & (occupied | ~by_user[~seen].any(0))
    return occupied & judged, judged


def occupied_by(
    boxes: Boxes,
    xy: Float[Tensor, "M T 2"],
    yaw: Float[Tensor, "M T"],
    valid: Bool[Tensor, "M T"],
    path: PathAhead,
) -> Bool[Tensor, "M T G"]:
    """Return which of the `CELLS` of a path each road user covers over time.

    Those that are behind the ego vehicle in its lane at first cover nothing: they follow it.

    Args:
        boxes: unbatched, in the frame of the path.
        xy, yaw, valid: their middles and headings over time, m and rad.
        path: the path.
    """
    x, y, z = boxes.centre.unbind(-1)
    # Road users behind the rear axle, in a strip that widens with distance
    behind = (x < 0) & (y.abs() < FOLLOWS_M - FOLLOWS_SLOPE * x)
    level = z.abs() < LEVEL_M + 0.5 * boxes.size_lwh[:, 2]
    return cells_covered(
        xy,
        yaw,
        valid & (~behind & level)[:, None],
        boxes.size_lwh[:, :2],
        path.xy,
        path.valid,
        path.front_m,
        HALF_WIDTH_M,
        CELLS,
        CELL_M,
    )


def _points_of(boxes: Boxes) -> Float[Tensor, "M P 2"]:
    """Return points all over the footprints of boxes."""
    share = torch.cartesian_prod(torch.linspace(-0.5, 0.5, 7), torch.linspace(-0.5, 0.5, 3))
    # A grid of points on the footprint, turned by the heading
    local = share * boxes.size_lwh[:, None, :2]
    cos, sin = boxes.yaw.cos()[:, None], boxes.yaw.sin()[:, None]
    turned = torch.stack(
        [cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]], dim=-1
    )
    return boxes.centre[:, None, :2] + turned


def _in_ego_frame(xyz: Float64[np.ndarray, "N 3"], log: Log, frame: int) -> Float64[np.ndarray, "N 3"]:
    return _in_frame(xyz, log.T_world_ego[frame])


def _in_frame(
    xyz: Float64[np.ndarray, "N 3"], T_world_ego: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "N 3"]:
    # Column vectors times the inverse pose, as rows
    T_ego_world = np.linalg.inv(T_world_ego)
    moved: Float64[np.ndarray, "N 3"] = xyz @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
    return moved
