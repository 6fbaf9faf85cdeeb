"""Reading of single messages of ROS and Foxglove into arrays: calibrations, points, poses."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64, Shaped
from scipy.spatial.transform import Rotation

from foredrive.errors import InputError

_NUMPY_OF_ROS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_NUMPY_OF_FOXGLOVE = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
"""Types of numbers, by the codes of ROS' PointField and of Foxglove's PackedElementField."""

_INTENSITY, _CHANNEL = ("intensity", "i", "reflectivity"), ("ring", "channel", "line", "laser_id")
_TIMES = ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset")
UNITS_NS = {"s": 10**9, "ms": 10**6, "us": 1000, "ns": 1}
_MAX_SHARE, _MIN_SHARE = 1.5, 0.05
"""The times of the points of a sweep cover more and less than these shares of the time between sweeps."""
_MAX_OFF_STAMP_S = 1.0
"""Largest difference of the time of a point and the stamp of its message."""
_MIN_RESOLUTION_S = 1e-3
"""Absolute times in 32 bits have a resolution of minutes."""
_DAY_S = 86_400.0


@dataclass(frozen=True)
class Calibration:
    """The calibration of a camera."""

    K: Float64[np.ndarray, "3 3"]
    """Pixel centres at +0.5; ROS and Foxglove have them at whole numbers."""
    dist: Float64[np.ndarray, "5"]
    size_hw: tuple[int, int]
    R_optical_cam: Float64[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """Rotation from the axes of the images to the optical frame; only rectified images are turned."""
    offset_m: float = 0.0
    """Distance to another camera in whose frame P is, as of the right one of a pair. It is not used."""


@dataclass(frozen=True)
class Cloud:
    """Points in the frame that their message names."""

    xyz_m: Float64[np.ndarray, "N 3"]
    intensity: Float64[np.ndarray, "N"] | None
    """Intensities as stored."""
    times: Shaped[np.ndarray, "N"] | None
    """Times as stored; `seconds_since_stamp` converts them."""
    channel: Float64[np.ndarray, "N"] | None


@dataclass(frozen=True)
class Placed:
    """The pose of a frame in another at one time."""

    parent: str
    child: str
    """Empty where a message does not say whose pose it is."""
    t_us: int
    T_parent_child: Float64[np.ndarray, "4 4"]
    fixed: bool = False
    """Whether it holds for all times (`is_static`)."""
    recorded_us: int = 0
    """Time at which the recorder received its message."""


def stamp_us(message: Any) -> int:
    """Return the time at which a message's content was measured, µs."""
    stamp = message.header.stamp if hasattr(message, "header") else message.timestamp
    # Stamps of Foxglove have seconds and nanos, those of ROS sec and nanosec
    if hasattr(stamp, "seconds"):
        return int(stamp.seconds) * 1_000_000 + int(stamp.nanos) // 1000
    return int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000


def frame_of(message: Any) -> str:
    """Return the name of the frame in which a message is given."""
    name = message.header.frame_id if hasattr(message, "header") else message.frame_id
    return str(name).lstrip("/")


def read_calibration(message: Any, rectified: bool = False) -> Calibration:
    """Return the calibration of a CameraInfo or CameraCalibration.

    Args:
        message: the calibration.
        rectified: whether it is that of rectified images: their camera matrix is in P, they have no
            distortion, and R turns the camera's axes to theirs. Else K and D hold, those of the raw images.

    Raises:
        InputError: it has no camera matrix, or its lens is not OpenCV's with five coefficients.
    """
    k, d, r, p = (
        np.array(getattr(message, name if hasattr(message, name) else name.upper()), np.float64)
        for name in "kdrp"
    )
    size_hw = int(message.height), int(message.width)
    model = message.distortion_model
    K, dist, R, offset_m = k, np.zeros(5), np.eye(3), 0.0
    if rectified:
        # A camera without distortion may leave P and R empty: its raw images are rectified
        if p.size == 12 and p.any():
            K = p.reshape(3, 4)[:, :3].reshape(-1)
            offset_m = float(-p[3] / p[0]) if p[0] else 0.0
        elif d.any():
            raise InputError("a camera of rectified images without P, their camera matrix")
        R = _rectification(r)
    if K.size != 9 or not np.isfinite(K).all() or K[0] <= 0 or K[4] <= 0:
        raise InputError(f"a camera without a calibration ({'P' if rectified else 'K'} is {K.tolist()})")
    if not rectified:
        # Without coefficients an equidistant lens is still a fisheye, so its name alone decides.
        if model not in ("plumb_bob", "rational_polynomial", "") or d[5:].any():
            raise InputError(f"lenses of the model {model!r} are not read; undistort the images first")
        dist[: min(len(d), 5)] = d[:5]
    K = K.reshape(3, 3).copy()
    # Pixel centres at +0.5
    K[:2, 2] += 0.5
    return Calibration(K, dist, size_hw, R, offset_m)


def _rectification(r: Float64[np.ndarray, "_"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation from rectified to camera axes: the inverse of a CameraInfo's R, if it is set."""
    if r.size != 9 or not r.any():
        return np.eye(3)
    R = r.reshape(3, 3)
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise InputError("a camera whose R is no rotation")
    return np.asarray(R.T)


def read_cloud(message: Any) -> Cloud:
    """Return the points of a PointCloud2 or PointCloud that are finite.

    A PointCloud of Foxglove has a pose in its frame, by which its points are moved.

    Raises:
        InputError: it has no x, y and z, or its data do not fit its fields.
    """
    cells = _cells(message)
    names = cells.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"a point cloud without x, y and z; it has {', '.join(names) or 'no fields'}")
    xyz = np.stack([cells[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    # Points without return are NaN in many drivers
    kept = np.isfinite(xyz).all(axis=-1)

    def column(wanted: tuple[str, ...]) -> np.ndarray | None:
        name = next((name for name in wanted if name in names), None)
        return None if name is None else cells[name][kept]

    intensity, channel = column(_INTENSITY), column(_CHANNEL)
    T = cloud_pose(message)
    return Cloud(
        xyz[kept] @ T[:3, :3].T + T[:3, 3],
        None if intensity is None else intensity.astype(np.float64),
        column(_TIMES),
        None if channel is None else channel.astype(np.float64),
    )


def cloud_pose(message: Any) -> Float64[np.ndarray, "4 4"]:
    """Return the pose of a cloud in the frame that its message names; only Foxglove's clouds have one."""
    pose = getattr(message, "pose", None)
    if pose is None or not any(
        (pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w)
    ):
        # A message of protocol buffers without the field has one of zeros, which is no rotation
        return np.eye(4)
    return _matrix(pose.position, pose.orientation)


def _cells(message: Any) -> np.ndarray:
    """Return the points of a cloud as a structured array, row by row.

    Its fields have the types and offsets that the message names.
    """
    data = bytes(message.data)
    if hasattr(message, "point_step"):
        step, width, height = int(message.point_step), int(message.width), int(message.height)
        row, order, numbers = int(message.row_step), ">" if message.is_bigendian else "<", _NUMPY_OF_ROS
        kinds = {one.name: (numbers.get(int(one.datatype)), int(one.offset)) for one in message.fields}
    else:
        step, order, numbers = int(message.point_stride), "<", _NUMPY_OF_FOXGLOVE
        width, height, row = len(data) // step if step else 0, 1, 0
        kinds = {one.name: (numbers.get(int(one.type)), int(one.offset)) for one in message.fields}
    # Rows begin every row_step bytes. Many drivers leave it 0, or write the size of all rows
    tight = width * step
    if row < tight or len(data) < (height - 1) * row + tight:
        row = tight
    if not kinds or step <= 0 or len(data) < (height - 1) * row + tight:
        raise InputError(f"a point cloud of {width * height} points of {step} bytes has {len(data)} bytes")
    for name, (kind, offset) in kinds.items():
        if kind is None or offset < 0 or offset + np.dtype(kind).itemsize > step:
            raise InputError(f"the field {name!r} of a point cloud does not fit into its points")
    layout = {
        "names": list(kinds),
        "formats": [f"{order}{kind}" for kind, _ in kinds.values()],
        "offsets": [offset for _, offset in kinds.values()],
        "itemsize": step,
    }
    cells = np.ndarray((height, width), np.dtype(layout), data, strides=(row, step))  # type: ignore[call-overload]
    return cells.reshape(-1)


def time_unit(times: Shaped[np.ndarray, "N"], stamp_us: int, period_s: float) -> str | None:
    """Return the unit of the times of a sweep's points, or None if they fit no unit.

    Absolute times lie around the stamp of the message, and relative ones cover about the time between two
    sweeps. Relative times that are much shorter, as of a flash lidar, are ns where they are whole numbers and
    s elsewhere.

    Args:
        times: as stored.
        stamp_us: stamp of their message, µs.
        period_s: time between two sweeps.
    """
    values = times.astype(np.float64)
    if not values.size or not np.isfinite(values).all():
        return None
    largest = float(np.abs(values).max())
    # Spacing of neighbouring numbers at the largest time: the resolution of the stored type
    step = float(np.spacing(np.abs(times).max())) if times.dtype.kind == "f" else 1.0
    # Absolute times: near the stamp, beyond a second, and precise enough
    for unit, ns in UNITS_NS.items():
        off_s = float(np.abs(values * (ns * 1e-9) - stamp_us * 1e-6).max())
        if off_s <= _MAX_OFF_STAMP_S < largest * ns * 1e-9 and step * ns * 1e-9 < _MIN_RESOLUTION_S:
            return unit
    # Relative times: the first unit, from large to small, in which they fit between two sweeps
    fitting = [unit for unit, ns in UNITS_NS.items() if largest * ns * 1e-9 <= _MAX_SHARE * period_s]
    # Much shorter than the period, the type of the numbers decides
    if fitting and largest * UNITS_NS[fitting[0]] * 1e-9 >= _MIN_SHARE * period_s:
        return fitting[0]
    usual = "ns" if times.dtype.kind in "iu" else "s"
    return usual if usual in fitting else None


def seconds_since_stamp(times: Shaped[np.ndarray, "N"], stamp_us: int, unit: str) -> Float64[np.ndarray, "N"]:
    """Return the times of points since the stamp of their message. Times beyond a day are absolute.

    Raises:
        InputError: a time is not finite, or far from the stamp.
    """
    ns = UNITS_NS[unit]
    values = times.astype(np.float64)
    # Times beyond a day can only be absolute
    absolute = bool(values.size) and np.abs(values).max() * ns * 1e-9 > _DAY_S
    if absolute and times.dtype.kind in "iu":  # exact, as whole numbers of ns
        since_s = (times.astype(np.int64) * ns - stamp_us * 1000) * 1e-9
    else:
        since_s = (values - (stamp_us * 1000 / ns if absolute else 0.0)) * (ns * 1e-9)
    if not np.isfinite(since_s).all() or np.abs(since_s).max(initial=0.0) > _MAX_OFF_STAMP_S:
        furthest_s = float(np.abs(since_s).max())
        raise InputError(f"point times in {unit} that are up to {furthest_s:g} s away from the stamp")
    return since_s


def is_static(topic: str) -> bool:
    """Return whether transforms of a topic hold for the whole recording, whenever they were sent."""
    return topic.endswith("tf_static")


def read_placed(message: Any) -> Iterator[Placed]:
    """Yield the transforms of a tf message, an odometry or a pose."""
    if hasattr(message, "transforms"):
        for one in message.transforms:
            yield _transform(one)
    elif hasattr(message, "parent_frame_id"):
        yield _transform(message)
    else:
        # A pose with covariance holds the pose one level deeper
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        child = str(getattr(message, "child_frame_id", "")).lstrip("/")
        T = _matrix(pose.position, pose.orientation)
        yield Placed(frame_of(message), child, stamp_us(message), T)


def _transform(message: Any) -> Placed:
    child = str(message.child_frame_id).lstrip("/")
    if hasattr(message, "parent_frame_id"):
        parent, xyz, turn = message.parent_frame_id.lstrip("/"), message.translation, message.rotation
    else:
        parent, xyz, turn = frame_of(message), message.transform.translation, message.transform.rotation
    return Placed(parent, child, stamp_us(message), _matrix(xyz, turn))


def _matrix(xyz: Any, turn: Any) -> Float64[np.ndarray, "4 4"]:
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w], np.float64)
    position = np.array([xyz.x, xyz.y, xyz.z], np.float64)
    # Quaternions are normalised below; one far from length 1 is none
    if not np.isfinite(position).all() or not 0.5 < np.linalg.norm(quaternion) < 2.0:
        raise InputError("a pose that is not finite, or whose quaternion is none")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    T[:3, 3] = position
    return T
