"""Boxes of a 123D log in the ego frame, with Foredrive's categories and velocities from the tracks."""

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Bool, Float64, Int, Int64
from py123d.api.scene.arrow.modalities.sync_utils import get_modality_table
from py123d.datatypes import ModalityType
from py123d.datatypes.detections.box_detection_label import BoxDetectionLabel, DefaultBoxDetectionLabel
from py123d.datatypes.detections.box_detections_metadata import BoxDetectionsSE3Metadata
from py123d.datatypes.vehicle_state.ego_state import EGO_TRACK_TOKEN
from scipy.spatial.transform import Rotation
from torch import Tensor

from foredrive.data.arrow_files import column_array, fixed_lists, reading
from foredrive.data.beam_casting import box_of_points
from foredrive.data.log_writer import DATASET
from foredrive.data.logs import Log
from foredrive.data.recorded import read_attributes, read_visibility
from foredrive.errors import InputError
from foredrive.scene import Boxes, Category, LidarSweep, Visibility
from foredrive.scene.boxes import UNKNOWN, unlabelled

_KEY = ModalityType.BOX_DETECTIONS_SE3.serialize()
_MAX_DIFFERENCE_S = 1.5
"""Maximum time between two observations of a track for a velocity, as in the nuScenes devkit's
`box_velocity`."""

_BACKWARDS = {"pandaset"}
"""Datasets whose boxes py123d 0.7 rotates by half a turn: all their moving cars seem to drive backwards."""

LEVELS_FROM = (0.4, 0.6, 0.8)
"""Visible shares at which nuScenes' second, third and fourth level begin."""

_DEFAULT_CATEGORY = {
    DefaultBoxDetectionLabel.VEHICLE: Category.CAR,
    DefaultBoxDetectionLabel.TWO_WHEELER: Category.BICYCLE,
    DefaultBoxDetectionLabel.PERSON: Category.PEDESTRIAN,
    DefaultBoxDetectionLabel.ANIMAL: Category.ANIMAL,
    DefaultBoxDetectionLabel.TRAFFIC_CONE: Category.TRAFFIC_CONE,
    DefaultBoxDetectionLabel.BARRIER: Category.BARRIER,
}
"""Categories of py123d's common labels. All other labels become OTHER."""

_FINER_CATEGORY = {
    Category.TRUCK: (
        "TRUCK BOX_TRUCK TRUCK_CAB LARGE_VEHICLE MEDIUM_SIZED_TRUCK SEMI_TRUCK HEAVY_TRUCK VEHICLE_TRUCK"
    ),
    Category.BUS: (
        "BUS ARTICULATED_BUS SCHOOL_BUS VEHICLE_BUS VEHICLE_BUS_BENDY VEHICLE_BUS_RIGID TROLLEY_BUS"
    ),
    Category.TRAILER: (
        "TRAILER VEHICULAR_TRAILER MESSAGE_BOARD_TRAILER TRAFFIC_LIGHT_TRAILER CARAVAN TOWED_OBJECT "
        "VEHICLE_TRAILER"
    ),
    Category.CONSTRUCTION_VEHICLE: "OTHER_VEHICLE_CONSTRUCTION_VEHICLE VEHICLE_CONSTRUCTION",
    Category.MOTORCYCLE: "MOTORCYCLE MOTORIZED_SCOOTER VEHICLE_MOTORCYCLE",
    Category.OTHER: "OTHER_VEHICLE_UNCOMMON OTHER_VEHICLE",
}
"""Names of native labels that are more specific than their common label. A name has the same meaning in every
dataset."""

_CATEGORY_OF_NAME = {name: category for category, names in _FINER_CATEGORY.items() for name in names.split()}


def category_of(label: BoxDetectionLabel) -> Category:
    """Return the category of a dataset's own label."""
    named = _CATEGORY_OF_NAME.get(label.name)
    return named if named is not None else _DEFAULT_CATEGORY.get(label.to_default(), Category.OTHER)


@dataclass(frozen=True, eq=False)
class Tracks:
    """All boxes of a log in the world frame, one row per box, in order of time. Hashed by identity."""

    first_row: Int64[np.ndarray, "R_1"]
    """Row r of 123D's box table has the boxes first_row[r] to first_row[r + 1] - 1."""
    centre: Float64[np.ndarray, "N 3"]
    R_world_box: Float64[np.ndarray, "N 3 3"]
    size_lwh: Float64[np.ndarray, "N 3"]
    velocity: Float64[np.ndarray, "N 3"]
    """Velocity, m/s. NaN where neither the log nor the track gives one."""
    track_id: Int64[np.ndarray, "N"]
    category: Int64[np.ndarray, "N"]
    is_object: Bool[np.ndarray, "N"]
    """False for the ego vehicle, and for boxes without length, width or height, which are left out."""
    num_points: Int64[np.ndarray, "N"]
    """Number of lidar returns, `UNKNOWN` where the log has none."""
    t_us: Int64[np.ndarray, "N"]
    row_t_us: Int64[np.ndarray, "R"]
    """Time of each row of the table."""


def read_boxes(log: Log, frame: int) -> Boxes | None:
    """Read the boxes of objects at a frame, unbatched, in its ego frame.

    The ego vehicle and boxes without length, width or height are left out.

    `num_points` is as logged. It is not counted here (`with_counted_points`). The visibility is the level of
    the logged share. Attributes are known where a recording or conversion has written them.

    Velocities are over ground, along the ego axes. They are the logged values if there are any. Otherwise
    they are the centred difference between the neighbouring observations of the track, or NaN.

    Returns:
        The boxes, or None if the frame is not annotated.

    Raises:
        InputError: the boxes cannot be read or are not finite.
    """
    tracks = read_tracks(log)
    row = None if tracks is None else box_row(log, frame)
    if tracks is None or row is None:
        return None
    row_range = slice(tracks.first_row[row], tracks.first_row[row + 1])
    is_object = tracks.is_object[row_range]
    rows = np.arange(row_range.start, row_range.stop)[is_object]
    # World to ego frame in double precision: world coordinates may be large
    T_ego_world = np.linalg.inv(log.T_world_ego[frame])
    R_ego_box = T_ego_world[:3, :3] @ tracks.R_world_box[rows]
    centre = tracks.centre[rows] @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
    velocity = tracks.velocity[rows] @ T_ego_world[:3, :3].T
    return Boxes(
        centre=torch.from_numpy(centre).float(),
        size_lwh=torch.from_numpy(tracks.size_lwh[rows]).float(),
        yaw=torch.from_numpy(np.arctan2(R_ego_box[:, 1, 0], R_ego_box[:, 0, 0])).float(),
        velocity=torch.from_numpy(velocity[:, :2]).float(),
        track_id=torch.from_numpy(tracks.track_id[rows]),
        category=torch.from_numpy(tracks.category[rows]),
        valid=torch.ones(len(rows), dtype=torch.bool),
        num_points=torch.from_numpy(tracks.num_points[rows]),
        **_recorded_labels(log, frame, is_object),
    )


def read_tracks(log: Log) -> Tracks | None:
    """Read all boxes of a log, those that are no objects included. Return None if it has none.

    Raises:
        InputError: the boxes cannot be read or are not finite.
    """
    file = log.file(_KEY)
    if not file.is_file():
        return None
    with reading(file, "the boxes"):
        return _tracks(log, file.stat().st_mtime_ns)


def read_track_ids(log: Log) -> dict[str, int]:
    """Read the id of each track of a log by its token, the ego vehicle's included. Empty without boxes.

    Raises:
        InputError: the boxes cannot be read.
    """
    file = log.file(_KEY)
    if not file.is_file():
        return {}
    with reading(file, "the boxes"):
        table = get_modality_table(log.path.folder, _KEY)
        if table is None:
            raise ValueError("the table is missing")
        # Columns are called MODALITY.NAME
        (name,) = [name for name in table.column_names if name.split(".")[-1] == "track_token"]
        tokens = np.array(column_array(table, name).flatten().to_pylist(), dtype=object)
    return dict(zip(tokens.tolist(), _track_ids(tokens).tolist(), strict=True))


def frames_with_boxes(log: Log) -> Int64[np.ndarray, "_"]:
    """Return the annotated frames."""
    return log.rows(_KEY)[0]


def box_row(log: Log, frame: int) -> int | None:
    """Return the row of a frame in the box table. Return None if the frame is not annotated."""
    frames, rows = log.rows(_KEY)
    row = int(np.searchsorted(frames, frame))
    return int(rows[row]) if row < len(frames) and frames[row] == frame else None


def _recorded_labels(log: Log, frame: int, kept: Bool[np.ndarray, "K"]) -> dict[str, Tensor]:
    """Return attribute and visibility of the boxes in `kept` among all boxes of the frame.

    Raises:
        InputError: they are of another number of boxes.
    """
    out = {name: torch.full((int(kept.sum()),), UNKNOWN) for name in ("attribute", "visibility")}
    attribute, share = read_attributes(log, frame), read_visibility(log, frame)
    if attribute is not None:
        out["attribute"] = _of_boxes(log, frame, "attributes", attribute, kept)
    if share is not None:
        # From the visible share to nuScenes' levels 1 to 4
        level = torch.bucketize(share, torch.tensor(LEVELS_FROM), right=True) + Visibility.V0_40
        level = level.where(share.isfinite(), UNKNOWN)
        out["visibility"] = _of_boxes(log, frame, "visibilities", level, kept)
    return out


def _of_boxes(
    log: Log, frame: int, what: str, values: Int[Tensor, "K"], kept: Bool[np.ndarray, "M"]
) -> Int[Tensor, "_"]:
    if len(values) != len(kept):
        raise InputError(f"{log.path.folder}: frame {frame} has {len(kept)} boxes and {len(values)} {what}")
    return values[torch.from_numpy(kept)]


def with_counted_points(boxes: Boxes, sweep: LidarSweep) -> Boxes:
    """Return unbatched boxes with the lidar returns inside counted where their number is unknown.

    A return in several boxes counts for the one with the nearest centre.
    """
    points = sweep.points_ego[sweep.valid & sweep.returned].double().numpy()
    box = box_of_points(
        points,
        boxes.centre.double().numpy(),
        0.5 * boxes.size_lwh.double().numpy(),
        boxes.yaw.double().numpy(),
    )
    counted = torch.from_numpy(np.bincount(box[box >= 0], minlength=len(boxes.yaw)))
    unknown = boxes.num_points == UNKNOWN
    return dataclasses.replace(boxes, num_points=boxes.num_points.where(~unknown, counted))


@functools.lru_cache(maxsize=4)
def _tracks(log: Log, _mtime_ns: int) -> Tracks:
    """Read the whole box table. A few tables are cached: neighbouring frames come from the same log."""
    table = get_modality_table(log.path.folder, _KEY)
    metadata = log.scene.get_modality_metadata(ModalityType.BOX_DETECTIONS_SE3)
    if table is None or not isinstance(metadata, BoxDetectionsSE3Metadata):
        raise ValueError("the table is missing, or its label set is unknown")
    column = {name.split(".")[-1]: column_array(table, name) for name in table.column_names}
    lists = column["bounding_box_se3"]
    # Lists of boxes: offsets may begin above 0 in a slice, while `flatten` begins at the first box
    first_row = lists.offsets.to_numpy().astype(np.int64) - lists.offsets[0].as_py()
    box = lists.flatten().flatten().to_numpy(zero_copy_only=False).reshape(-1, 10)
    tokens = np.array(column["track_token"].flatten().to_pylist(), dtype=object)
    labels = column["label"].flatten().to_numpy(zero_copy_only=False)
    kinds, kind = np.unique(labels, return_inverse=True)
    of_kind = [metadata.box_detection_label_class(int(value)) for value in kinds]
    category = np.array([category_of(label) for label in of_kind], dtype=np.int64)
    is_ego = np.array([label.to_default() == DefaultBoxDetectionLabel.EGO for label in of_kind], dtype=bool)
    # Ten numbers for each box: x y z, qw qx qy qz, length width height
    bad = ~np.isfinite(box).all(-1) | (np.linalg.norm(box[:, 3:7], axis=-1) < 0.5)
    if bad.any():
        row = np.searchsorted(first_row, bad.argmax(), side="right") - 1
        raise InputError(f"{log.file(_KEY)}: a box in row {row} is not finite")
    track_id = _track_ids(tokens)
    t_us = np.repeat(column["timestamp_us"].to_numpy(), np.diff(first_row))
    t_s = t_us * 1e-6
    logged = fixed_lists(column["velocity_3d"].flatten(), 3)
    if log.metadata.dataset != DATASET:
        logged[(logged == 0).all(-1)] = np.nan  # py123d's parsers write zeros for unknown velocities
    difference = _track_velocity(track_id, t_s, box[:, :3])
    quaternion = box[:, 3:7].copy()  # scipy rejects empty read-only arrays
    R_world_box = Rotation.from_quat(quaternion, scalar_first=True).as_matrix().reshape(-1, 3, 3)
    if log.metadata.dataset in _BACKWARDS:
        R_world_box = R_world_box @ np.diag([-1.0, -1.0, 1.0])
    return Tracks(
        first_row=first_row,
        centre=box[:, :3],
        R_world_box=R_world_box,
        size_lwh=box[:, 7:],
        velocity=np.where(np.isfinite(logged), logged, difference),
        track_id=track_id,
        category=category[kind],
        is_object=~is_ego[kind] & (tokens != EGO_TRACK_TOKEN) & (box[:, 7:] > 0).all(-1),
        num_points=_num_points(column.get("num_lidar_points"), len(tokens)),
        t_us=t_us.astype(np.int64),
        row_t_us=column["timestamp_us"].to_numpy().astype(np.int64),
    )


def _num_points(column: pa.Array | None, count: int) -> Int64[np.ndarray, "N"]:
    """Return the logged numbers of lidar returns. A log of an earlier version may lack the column."""
    if column is None:
        return np.full(count, UNKNOWN, dtype=np.int64)
    if len(column.flatten()) != count:
        raise ValueError(f"{count} boxes, but {len(column.flatten())} numbers of lidar returns")
    return column.flatten().fill_null(UNKNOWN).to_numpy(zero_copy_only=False).astype(np.int64)


def _track_ids(tokens: np.ndarray) -> Int64[np.ndarray, "N"]:
    """Return integer track ids.

    Numeric tokens keep their value. Other tokens are numbered in alphabetical order.
    """
    if all(token.isdecimal() and len(token) < 19 for token in tokens):
        return np.array([int(token) for token in tokens], dtype=np.int64)
    return np.unique(tokens.astype(str), return_inverse=True)[1].astype(np.int64)


def _track_velocity(
    track_id: Int64[np.ndarray, "N"], t_s: Float64[np.ndarray, "N"], centre: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Return the difference between the observations before and after each box; one-sided at the ends."""
    order = np.lexsort((t_s, track_id))
    track, time_s, xyz = track_id[order], t_s[order], centre[order]
    # Whether neighbours in this order are observations of one track, not too far apart in time
    joined = (np.diff(track) == 0) & (np.diff(time_s) <= _MAX_DIFFERENCE_S)
    # Where there is no neighbour, the observation itself takes its place: a one-sided difference
    before = np.arange(len(order)) - np.concatenate([[False], joined])[: len(order)]
    after = np.arange(len(order)) + np.concatenate([joined, [False]])[: len(order)]
    span_s = time_s[after] - time_s[before]
    velocity = np.full_like(xyz, np.nan)
    moved = span_s > 0
    velocity[moved] = (xyz[after] - xyz[before])[moved] / span_s[moved, None]
    out = np.empty_like(velocity)
    out[order] = velocity
    return out


def no_boxes() -> Boxes:
    """Return the boxes of a frame without any box."""
    return Boxes(
        centre=torch.zeros(0, 3),
        size_lwh=torch.zeros(0, 3),
        yaw=torch.zeros(0),
        velocity=torch.zeros(0, 2),
        track_id=torch.zeros(0, dtype=torch.int64),
        category=torch.zeros(0, dtype=torch.int64),
        valid=torch.zeros(0, dtype=torch.bool),
        **unlabelled(0),
    )
