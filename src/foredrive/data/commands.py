"""The driving command at a frame, from the log's route or from the driven future."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from py123d.api.scene.arrow.modalities.sync_utils import get_modality_table
from py123d.datatypes import ModalityType, RouteMetadata
from torch import Tensor

from foredrive.data.arrow_files import reading
from foredrive.data.logs import Log
from foredrive.geometry.polylines import points_at
from foredrive.scene import Command, Trajectory
from foredrive.scene.clip import ROUTE_M

LATERAL_M = 2.0
"""Minimum lateral offset of a turn, by the nuScenes convention (ST-P3, UniAD, VAD)."""
LOOKAHEAD_M = 20.0
"""Lookahead distance along the route: about three seconds of city driving."""
HEADING_OVER_M = 2.0
"""Length of the chord that defines the route's heading. A chord is needed because routes are polylines."""


def command_at(log: Log, frame: int, future: Trajectory) -> tuple[Command | None, str]:
    """Return the command and its source: "route", "driven_future" or "none".

    The driven future reveals information on which an agent is evaluated, so the source is reported. A route
    counts only if it was provided to the vehicle. Without one, py123d derives a route from the driven path.

    Raises:
        InputError: the route cannot be read.
    """
    lateral_m = _route_offset_m(log, frame)
    # A provided route comes first; the driven future tells an agent where the vehicle will go
    if lateral_m is not None:
        return command_of(lateral_m), "route"
    valid = future.valid[0].numpy()
    if not valid.any():
        return None, "none"
    return command_of(float(future.xy[0, np.flatnonzero(valid)[-1], 1])), "driven_future"


def count_command_sources(log: Log, nows: Int64[np.ndarray, "N"], steps: int, dt_s: float) -> dict[str, int]:
    """Return how many frames have each source of `command_at`, without their commands.

    Args:
        steps: steps of the driven future, `dt_s` apart.

    Raises:
        InputError: the route cannot be read.
    """
    routed = np.isin(nows, _frames_with_route(log))
    future_us = log.t_us[nows[~routed], None] + np.arange(1, steps + 1) * dt_s * 1e6
    driven = int(log.knows_pose_at(future_us).any(axis=-1).sum())
    route = int(routed.sum())
    return {"route": route, "driven_future": driven, "none": len(nows) - route - driven}


def command_of(lateral_m: float) -> Command:
    """Return the command for a route or path with this lateral offset (m, positive to the left)."""
    if lateral_m >= LATERAL_M:
        return Command.LEFT
    return Command.RIGHT if lateral_m <= -LATERAL_M else Command.STRAIGHT


class RouteAhead(NamedTuple):
    """The next points of a route, `scene.clip.ROUTE_M` from the point beside the vehicle."""

    xy: Float64[np.ndarray, "R 2"]
    """Vehicle frame: x forward, y left, m. Points beyond the end of the route are its end."""
    valid: Bool[np.ndarray, "R"]
    """False beyond the end of the route."""


def clip_route(route: RouteAhead | None) -> tuple[Float[Tensor, "R 2"], Bool[Tensor, "R"]]:
    """Return `route_xy` and `route_valid` of an unbatched `Clip`. None: no route was given."""
    if route is None:
        return torch.zeros(len(ROUTE_M), 2), torch.zeros(len(ROUTE_M), dtype=torch.bool)
    return torch.from_numpy(route.xy).float(), torch.from_numpy(route.valid)


def route_ahead_at(log: Log, frame: int) -> RouteAhead | None:
    """Return the next points of the route, or None without a provided route.

    Raises:
        InputError: the route cannot be read.
    """
    route = route_at(log, frame)
    if route is None:
        return None
    arc_m, xyz, progress_m = route
    return route_ahead(arc_m, xyz[:, :2], progress_m, log.T_world_ego[frame])


def route_ahead(
    arc_m: Float64[np.ndarray, "K"],
    xy: Float64[np.ndarray, "K 2"],
    progress_m: float,
    T_world_ego: Float64[np.ndarray, "4 4"],
) -> RouteAhead:
    """Return the next points of a route.

    Args:
        xy: the route, m.
        arc_m: arc length of each route point.
        progress_m: arc length of the ego's projection on the route.
    """
    at_m = progress_m + np.array(ROUTE_M)
    dx, dy = (points_at(xy, arc_m, at_m) - T_world_ego[:2, 3]).T
    # Turn by the heading only, so that pitch and roll do not shorten distances
    forward = T_world_ego[:2, 0] / np.hypot(*T_world_ego[:2, 0])
    ego_xy = np.stack([dx * forward[0] + dy * forward[1], dy * forward[0] - dx * forward[1]], axis=-1)
    # Next to the end of the route, the first point is still valid: the vehicle has to stop there
    return RouteAhead(ego_xy, np.append(True, at_m[1:] <= arc_m[-1]))


def _route_offset_m(log: Log, frame: int) -> float | None:
    """Return `route_offset_m` at a frame, or None without a provided route."""
    route = route_at(log, frame)
    return None if route is None else route_offset_m(route[0], route[1][:, :2], route[2])


def route_at(
    log: Log, frame: int
) -> tuple[Float64[np.ndarray, "K"], Float64[np.ndarray, "K 3"], float] | None:
    """Return arc length and points of the route, and the ego's progress along it (m).

    Return None without a provided route.

    Raises:
        InputError: the route cannot be read.
    """
    metadata = _provided_route(log)
    if metadata is None:
        return None
    with reading(log.file(metadata.modality_key), f"the route at frame {frame}"):
        progress_m = log.scene.get_route_progress_at_iteration(log.iteration(frame))
        if progress_m is None:
            return None
        return metadata.polyline_arc_m, metadata.polyline_xyz, float(progress_m)


def _provided_route(log: Log) -> RouteMetadata | None:
    metadata = log.scene.get_modality_metadata(ModalityType.ROUTE_POSITION)
    provided = isinstance(metadata, RouteMetadata) and metadata.source == "provided"
    return metadata if provided else None


def _frames_with_route(log: Log) -> Int64[np.ndarray, "K"]:
    """Return the frames at which `route_at` has a route."""
    metadata = _provided_route(log)
    if metadata is None:
        return np.zeros(0, dtype=np.int64)
    key = metadata.modality_key
    with reading(log.file(key), "the progress along the route"):
        frames, rows = log.rows(key)
        progress = get_modality_table(log.path.folder, key)[f"{key}.progress_m"]
        return frames[progress.is_valid().to_numpy(zero_copy_only=False)[rows]]


def route_offset_m(
    arc_m: Float64[np.ndarray, "K"], xy: Float64[np.ndarray, "K 2"], progress_m: float
) -> float:
    """Return the lateral offset of the route LOOKAHEAD_M ahead, relative to its heading at `progress_m`.

    The offset is in m, positive to the left. It depends only on the route: a lateral offset of the vehicle,
    as in overtaking, is not a turn.

    Args:
        arc_m: arc length of each route point.
        progress_m: arc length of the ego's projection on the route.
    """
    half_m = 0.5 * HEADING_OVER_M
    # The chord lies on the route, also at its ends
    at_m = np.clip(progress_m, arc_m[0] + half_m, arc_m[-1] - half_m)
    along_m = [at_m - half_m, at_m + half_m, progress_m, progress_m + LOOKAHEAD_M]
    behind, ahead, here, beyond = points_at(xy, arc_m, np.array(along_m))
    (dx, dy), (x, y) = ahead - behind, beyond - here
    # The cross product with the heading's unit vector
    return float((dx * y - dy * x) / max(np.hypot(dx, dy), 1e-9))
