"""Motion of a log's tracks at any times: futures of road users, and where vehicles are later."""

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from foredrive.data.boxes import Tracks, box_row, read_boxes, read_tracks
from foredrive.data.logs import Log
from foredrive.data.truth.raster import fill_polygon
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.boxes import VEHICLES
from foredrive.scene.map_elements import InstanceRaster, PlaneSpec

MAX_GAP_S = 0.75
"""Maximum time between two observations of a track for interpolation. An object that one key frame of
nuScenes lacks is not filled in there, as in nuScenes' own evaluation."""
SLACK_S = 0.05
"""Time beyond the ends of a track to which its motion is continued. Frames do not lie at exact multiples of
the step."""
_TRACK_US = 1 << 44
"""More than any log lasts, µs. Track number times this, plus time, orders boxes by track, then time."""


@dataclass(frozen=True)
class TrackStates:
    """K tracks at S times, in the ego frame at now."""

    xy: Float64[np.ndarray, "K S 2"]
    yaw: Float64[np.ndarray, "K S"]
    valid: Bool[np.ndarray, "K S"]
    box: Int64[np.ndarray, "K S"]
    """Index in `Tracks` of the observation before each time."""


def read_futures(log: Log, frame: int, steps: int, dt_s: float) -> AgentFutures:
    """Read the futures of the boxes of `read_boxes`, unbatched. Without annotation there are none.

    Positions and headings are interpolated between the observations of a track.

    Raises:
        InputError: the boxes cannot be read.
    """
    boxes, tracks = read_boxes(log, frame), read_tracks(log)
    if boxes is None or tracks is None or not len(boxes.yaw):
        return AgentFutures(torch.zeros(0, steps, 2), torch.zeros(0, steps), _no(0, steps), dt_s)
    # Times of the steps, from the annotation at now on
    t_us = _now_us(log, frame, tracks) + np.round(np.arange(1, steps + 1) * dt_s * 1e6).astype(np.int64)
    states = track_states(tracks, log.T_world_ego[frame], boxes.track_id.numpy(), t_us)
    valid = torch.from_numpy(states.valid)
    return AgentFutures(
        xy=torch.from_numpy(states.xy).float() * valid[..., None],
        yaw=torch.from_numpy(states.yaw).float() * valid,
        valid=valid,
        dt_s=dt_s,
    )


def read_instances(log: Log, frame: int, steps: int, dt_s: float, spec: PlaneSpec) -> InstanceRaster:
    """Read where the vehicles are at now and at the next `steps` steps, unbatched.

    The classes are `VEHICLES`. Vehicles that appear later are drawn, and hidden ones too. A step is valid if
    the log is annotated within `MAX_GAP_S` before and after it.

    Raises:
        InputError: the boxes cannot be read.
    """
    drawn = np.zeros((steps + 1, *spec.shape_yx), dtype=np.int32)
    tracks = read_tracks(log)
    if tracks is None or box_row(log, frame) is None:
        return InstanceRaster(spec, torch.from_numpy(drawn).long(), _no(steps + 1), dt_s)
    t_us = _now_us(log, frame, tracks) + np.round(np.arange(steps + 1) * dt_s * 1e6).astype(np.int64)
    # Tracks of vehicles; a track has one number in the drawing
    vehicles = np.isin(tracks.category, [int(kind) for kind in VEHICLES]) & tracks.is_object
    ids = np.unique(tracks.track_id[vehicles])
    states = track_states(tracks, log.T_world_ego[frame], ids, t_us)
    valid = annotated_at(tracks, t_us)
    for step in range(steps + 1):
        rows = np.flatnonzero(states.valid[:, step] & valid[step])
        size_m = tracks.size_lwh[states.box[rows, step], :2]
        # Cells of each box at the step, by the size of the observation before it
        quads = box_corners_xy(states.xy[rows, step], size_m, states.yaw[rows, step])
        for track, quad in zip(rows.tolist(), quads, strict=True):
            fill_polygon([quad], track + 1, spec, drawn[step])
    # The drawing holds rows + 1: replace them by track ids + 1
    track_id = np.concatenate([[0], ids + 1])[drawn]
    return InstanceRaster(spec, torch.from_numpy(track_id), torch.from_numpy(valid), dt_s)


def track_states(
    tracks: Tracks,
    T_world_ego: Float64[np.ndarray, "4 4"],
    track_id: Int64[np.ndarray, "K"],
    t_us: Int64[np.ndarray, "S"],
) -> TrackStates:
    """Return tracks at any times in an ego frame, linear between the observations around each time."""
    order, ids, key = in_order_of_tracks(tracks)
    start_us = tracks.row_t_us[0]
    # Range of each track's boxes in the sorted key
    wanted = np.searchsorted(ids, track_id)[:, None] * _TRACK_US
    first = np.searchsorted(key, wanted)
    end = np.searchsorted(key, wanted + _TRACK_US)
    # Observations before and after each time; at the ends of a track the two nearest ones
    row = np.searchsorted(key, wanted + np.maximum(t_us - start_us, 0), side="right")
    before = np.clip(row - 1, first, np.maximum(end - 2, first))
    after = np.minimum(before + 1, end - 1)
    rows = order[np.stack([before, after])]  # [2 K S]
    time_us = tracks.t_us[rows]
    span_us = time_us[1] - time_us[0]
    # Share of the time between the two observations; beyond the ends the motion continues
    share = np.where(span_us > 0, (t_us - time_us[0]) / np.maximum(span_us, 1), 0.0)
    slack_us = SLACK_S * 1e6
    # Valid within a short gap, or next to an observation
    inside = (t_us >= time_us[0] - slack_us) & (t_us <= time_us[1] + slack_us)
    observed = (np.abs(t_us - time_us) <= slack_us).any(axis=0)
    T_ego_world = np.linalg.inv(T_world_ego)
    centre = tracks.centre[rows] @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
    # First column of the rotation: the direction ahead of the box
    ahead = tracks.R_world_box[rows][..., 0] @ T_ego_world[:3, :3].T
    yaw = np.arctan2(ahead[..., 1], ahead[..., 0])
    # The shorter way round
    turn = _wrapped(yaw[1] - yaw[0])
    xy = centre[0] + share[..., None] * (centre[1] - centre[0])
    return TrackStates(
        xy=xy[..., :2],
        yaw=_wrapped(yaw[0] + share * turn),
        valid=observed | (inside & (span_us <= MAX_GAP_S * 1e6)),
        box=rows[0],
    )


@functools.lru_cache(maxsize=4)
def in_order_of_tracks(tracks: Tracks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the boxes by track and time, the ids of the tracks, and the sorted key of each box."""
    ids, number = np.unique(tracks.track_id, return_inverse=True)
    # One sortable number for each box: track first, then time
    key = number * _TRACK_US + (tracks.t_us - tracks.row_t_us[0])
    order = np.argsort(key, kind="stable")
    return order, ids, key[order]


def _now_us(log: Log, frame: int, tracks: Tracks) -> int:
    row = box_row(log, frame)
    return int(log.t_us[frame] if row is None else tracks.row_t_us[row])


def annotated_at(tracks: Tracks, t_us: Int64[np.ndarray, "S"]) -> Bool[np.ndarray, "S"]:
    """Return whether there are annotated rows of a log close before and after each time, µs."""
    row_t_us = tracks.row_t_us
    # First annotated row after, and last one before, each time
    after = np.searchsorted(row_t_us, t_us - SLACK_S * 1e6)
    before = np.searchsorted(row_t_us, t_us + SLACK_S * 1e6, side="right") - 1
    inside = (after < len(row_t_us)) & (before >= 0)
    gap_us = row_t_us[after.clip(0, len(row_t_us) - 1)] - row_t_us[before.clip(0)]
    return inside & (gap_us <= MAX_GAP_S * 1e6)


def box_corners_xy(
    xy: Float64[np.ndarray, "K 2"], size_lw: Float64[np.ndarray, "K 2"], yaw: Float64[np.ndarray, "K"]
) -> Float64[np.ndarray, "K 4 2"]:
    """Return the corners of boxes from above, m."""
    local = 0.5 * size_lw[:, None] * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    turned = np.stack(
        [cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]], -1
    )
    return turned + xy[:, None]


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles in [-π, π)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _no(*shape: int) -> torch.Tensor:
    return torch.zeros(*shape, dtype=torch.bool)
