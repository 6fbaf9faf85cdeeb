"""Contacts of the recording vehicle with boxes of its log: a drive through somebody demonstrates nothing."""

from weakref import WeakKeyDictionary

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int64

from foredrive.data.boxes import Tracks, read_tracks
from foredrive.data.logs import Log
from foredrive.data.truth.agent_futures import MAX_GAP_S, box_corners_xy, in_order_of_tracks

STEP_SHARES = np.linspace(0.0, 1.0, 11)
"""Times at which contact is tested, as shares of the time between two observations of a track."""
NEAR_M, LEVEL_M = 30.0, 2.5
"""Largest distance from the vehicle along one axis, and above or below it, of boxes that are tested, m."""
BEFORE_S = 2.0
"""A future demonstrates nothing if it ends less than this before a contact: a driver would brake by then."""
_contact_us: WeakKeyDictionary[Log, Int64[np.ndarray, "_"]] = WeakKeyDictionary()
"""Times of contact of each opened log, which go with the log."""


def demonstrates(log: Log, frame: int, horizon_s: float) -> bool:
    """Return whether the drive from a frame on touches nobody within a horizon and `BEFORE_S` after it.

    Virtual egos drive through people who were added to recorded traffic, and agents in closed loop collide.

    Raises:
        InputError: the boxes cannot be read.
    """
    if log not in _contact_us:
        _contact_us[log] = contact_times(log)
    contact_us = _contact_us[log]
    first, end = log.t_us[frame], log.t_us[frame] + (horizon_s + BEFORE_S) * 1e6
    return not bool(((contact_us >= first) & (contact_us <= end)).any())


def contact_times(log: Log) -> Int64[np.ndarray, "_"]:
    """Return the times at which the vehicle's box overlaps a box of the log from above, µs, in no order.

    Tracks move linearly between two observations that are at most `MAX_GAP_S` apart.

    Raises:
        InputError: the boxes cannot be read.
    """
    tracks = read_tracks(log)
    if tracks is None or not tracks.is_object.any():
        return np.zeros(0, dtype=np.int64)
    before, after = _steps(log, tracks)
    # Each pair of observations at several times between them: [K S]
    t_us = np.round(_between(tracks.t_us[before], tracks.t_us[after]))
    centre = _between(tracks.centre[before], tracks.centre[after])
    yaw = np.unwrap(np.stack([_yaw(tracks, before), _yaw(tracks, after)]), axis=0)
    corners = box_corners_xy(
        centre[..., :2].reshape(-1, 2),
        np.repeat(tracks.size_lwh[before, :2], len(STEP_SHARES), axis=0),
        _between(yaw[0], yaw[1]).ravel(),
    )
    ego = _ego_corners(log, t_us.ravel())
    touches = shapely.intersects(shapely.polygons(ego), shapely.polygons(corners))
    return np.unique(t_us.ravel()[touches].astype(np.int64))


def _steps(log: Log, tracks: Tracks) -> tuple[Int64[np.ndarray, "K"], Int64[np.ndarray, "K"]]:
    """Return the observations near the vehicle and those of the same track that follow, else themselves."""
    order, _, _ = in_order_of_tracks(tracks)
    first, second = order[:-1], order[1:]
    follows = tracks.track_id[first] == tracks.track_id[second]
    follows &= tracks.t_us[second] - tracks.t_us[first] <= MAX_GAP_S * 1e6
    after = order.copy()
    after[:-1][follows] = second[follows]
    near = tracks.is_object[order] & _near(log, tracks)[order]
    return order[near], after[near]


def _near(log: Log, tracks: Tracks) -> Bool[np.ndarray, "N"]:
    T_world_ego, known = log.poses_at(tracks.t_us.astype(np.float64))
    offset_m = np.abs(tracks.centre - T_world_ego[:, :3, 3])
    # Half the box's height, because its middle is above the road and the vehicle's frame on it
    level = offset_m[:, 2] < LEVEL_M + 0.5 * tracks.size_lwh[:, 2]
    return np.asarray(known & level & (offset_m[:, :2] < NEAR_M).all(-1))


def _between(first: np.ndarray, second: np.ndarray) -> Float64[np.ndarray, "K S ..."]:
    """Interpolate K pairs at the shares of `STEP_SHARES`."""
    share = STEP_SHARES.reshape(1, -1, *[1] * (first.ndim - 1))
    return np.asarray(first[:, None] + share * (second - first)[:, None])


def _yaw(tracks: Tracks, rows: Int64[np.ndarray, "K"]) -> Float64[np.ndarray, "K"]:
    ahead = tracks.R_world_box[rows][..., 0]
    return np.asarray(np.arctan2(ahead[:, 1], ahead[:, 0]))


def _ego_corners(log: Log, t_us: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 4 2"]:
    """Return the corners of the vehicle's box from above, world frame, m."""
    T_world_ego, _ = log.poses_at(t_us)
    centre_ego, size_m = log.ego_box
    centre = T_world_ego[:, :3, :3] @ centre_ego + T_world_ego[:, :3, 3]
    yaw = np.arctan2(T_world_ego[:, 1, 0], T_world_ego[:, 0, 0])
    return box_corners_xy(centre[:, :2], np.broadcast_to(size_m[:2], (len(yaw), 2)), yaw)
