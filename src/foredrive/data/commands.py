"""The driving command at a frame: from the log's route, or else from the driven future."""

import numpy as np
from jaxtyping import Float64
from py123d.datatypes import ModalityType, RouteMetadata

from foredrive.data.arrow_files import reading
from foredrive.data.logs import Log
from foredrive.scene import Command, Trajectory

LATERAL_M = 2.0
"""nuScenes convention (ST-P3, UniAD, VAD): further to the side than this is a turn."""
LOOKAHEAD_M = 20.0
"""How far ahead the route is asked: about three seconds of city driving."""
HEADING_OVER_M = 2.0
"""The route's heading is that of a chord this long: routes are polylines."""


def command_at(log: Log, frame: int, future: Trajectory) -> tuple[Command | None, str]:
    """The command and its source: "route", "driven_future" or "none".

    The driven future leaks what an agent is judged on, hence the source. A route counts only if it was given
    to the vehicle: py123d derives one from the driven path where there is none.

    Raises:
        InputError: on a route that cannot be read.
    """
    lateral_m = _route_offset_m(log, frame)
    if lateral_m is not None:
        return command_of(lateral_m), "route"
    valid = future.valid[0].numpy()
    if not valid.any():
        return None, "none"
    return command_of(float(future.xy[0, np.flatnonzero(valid)[-1], 1])), "driven_future"


def command_of(lateral_m: float) -> Command:
    """The command for a route, or a path, that bears so far to the left."""
    if lateral_m >= LATERAL_M:
        return Command.LEFT
    return Command.RIGHT if lateral_m <= -LATERAL_M else Command.STRAIGHT


def target_at(log: Log, frame: int) -> Float64[np.ndarray, "2"] | None:
    """Where the route leads, as `route_target`; None without a provided route.

    Raises:
        InputError: on a route that cannot be read.
    """
    route = _route_at(log, frame)
    return None if route is None else route_target(*route, log.T_world_ego[frame])


def route_target(
    arc_m: Float64[np.ndarray, "K"],
    xy: Float64[np.ndarray, "K 2"],
    progress_m: float,
    T_world_ego: Float64[np.ndarray, "4 4"],
) -> Float64[np.ndarray, "2"]:
    """The route's point LOOKAHEAD_M ahead, or its end, seen from the vehicle: x forward, y left, m.

    Args:
        arc_m: arc length of each point of the route.
        progress_m: arc length of the ego's projection on it.
    """
    ahead = np.array([np.interp(progress_m + LOOKAHEAD_M, arc_m, axis) for axis in xy.T])
    forward = T_world_ego[:2, 0] / np.hypot(*T_world_ego[:2, 0])
    dx, dy = ahead - T_world_ego[:2, 3]
    return np.array([dx * forward[0] + dy * forward[1], dy * forward[0] - dx * forward[1]])


def _route_offset_m(log: Log, frame: int) -> float | None:
    """How far left the route bears from where the ego is beside it; None without a provided route."""
    route = _route_at(log, frame)
    return None if route is None else route_offset_m(*route)


def _route_at(
    log: Log, frame: int
) -> tuple[Float64[np.ndarray, "K"], Float64[np.ndarray, "K 2"], float] | None:
    """Arc length and points of the route, and how far along it the ego is."""
    metadata = log.scene.get_modality_metadata(ModalityType.ROUTE_POSITION)
    if not isinstance(metadata, RouteMetadata) or metadata.source != "provided":
        return None
    with reading(log.file(metadata.modality_key), f"the route at frame {frame}"):
        progress_m = log.scene.get_route_progress_at_iteration(log.iteration(frame))
        if progress_m is None:
            return None
        return metadata.polyline_arc_m, metadata.polyline_xyz[:, :2], float(progress_m)


def route_offset_m(
    arc_m: Float64[np.ndarray, "K"], xy: Float64[np.ndarray, "K 2"], progress_m: float
) -> float:
    """How far left of the route's heading at `progress_m` the route is LOOKAHEAD_M later, m.

    Measured along the route alone: where the vehicle is beside it, overtaking or swaying, is no turn.

    Args:
        arc_m: arc length of each point of the route.
        progress_m: arc length of the ego's projection on it.
    """
    half_m = 0.5 * HEADING_OVER_M
    at_m = np.clip(progress_m, arc_m[0] + half_m, arc_m[-1] - half_m)
    along_m = [at_m - half_m, at_m + half_m, progress_m, progress_m + LOOKAHEAD_M]
    behind, ahead, here, there = np.stack([np.interp(along_m, arc_m, axis) for axis in xy.T], axis=1)
    (dx, dy), (x, y) = ahead - behind, there - here
    return float((dx * y - dy * x) / max(np.hypot(dx, dy), 1e-9))
