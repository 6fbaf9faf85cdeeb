"""Reading of single messages of ROS and Foxglove into arrays: images, calibrations, points, poses."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Shaped, UInt8
from scipy.spatial.transform import Rotation

from foredrive.data.images import decoded, grey_to_rgb
from foredrive.errors import InputError

_NUMPY_OF_ROS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_NUMPY_OF_FOXGLOVE = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
"""PointField.datatype and PackedElementField.NumericType."""

_TO_RGB = {
    "rgb8": None,
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "8UC3": cv2.COLOR_BGR2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
    "8UC1": cv2.COLOR_GRAY2RGB,
    "mono16": None,
    "16UC1": None,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "yuyv": cv2.COLOR_YUV2RGB_YUYV,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUYV,
}
"""OpenCV's conversions of ROS' and Foxglove's encodings. A Bayer pattern is named by its first two rows."""
_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4}
_DEEP = ("mono16", "16UC1")
_PAIRED = ("uyvy", "yuv422", "yuyv", "yuv422_yuy2")
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


@dataclass(frozen=True)
class Cloud:
    """Points in the frame of their sensor."""

    xyz_m: Float64[np.ndarray, "N 3"]
    intensity: Float64[np.ndarray, "N"] | None
    """As stored."""
    times: Shaped[np.ndarray, "N"] | None
    """As stored; `seconds_since_stamp` knows their unit and origin."""
    channel: Float64[np.ndarray, "N"] | None


@dataclass(frozen=True)
class Placed:
    """The pose of a frame in another at one time."""

    parent: str
    child: str
    """Empty where a message does not say whose pose it is."""
    t_us: int
    T_parent_child: Float64[np.ndarray, "4 4"]


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


def read_image(message: Any, value_range: tuple[float, float] | None = None) -> UInt8[np.ndarray, "H W 3"]:
    """Return an image as RGB.

    Args:
        message: an Image, CompressedImage or RawImage.
        value_range: values of an image with 16 bits that become 0 and 255.

    Raises:
        InputError: the encoding is not known, the data do not fit it, or 16 bits have no range.
    """
    pixels = read_pixels(message)
    if pixels.ndim == 3:
        return pixels
    if value_range is None:
        raise InputError(
            f"an image of 16 bits ({pixels.min()} to {pixels.max()}); the YAML needs its `value_range`"
        )
    return grey_to_rgb(pixels, value_range)


def read_pixels(message: Any) -> Shaped[np.ndarray, "H W *channels"]:
    """Return an image as uint8 RGB [H, W, 3], or as grey [H, W] if it has 16 bits.

    Raises:
        InputError: the encoding is not known, or the data do not fit it.
    """
    if not hasattr(message, "encoding"):
        return decoded(bytes(message.data))
    encoding = message.encoding
    if encoding not in _TO_RGB:
        raise InputError(f"images of encoding {encoding!r} are not read; there are: {', '.join(_TO_RGB)}")
    step, height, width = int(message.step), int(message.height), int(message.width)
    depth = np.dtype("u2" if encoding in _DEEP else "u1")
    channels = 2 if encoding in _PAIRED else _CHANNELS.get(encoding, 1)
    data = np.frombuffer(bytes(message.data), np.uint8)
    # Rows may be padded to a step, but never shorter than their pixels
    row = width * channels * depth.itemsize
    if data.size != height * step or row > step or not row or not height:
        raise InputError(f"an image of {height} x {width} px in rows of {step} bytes has {data.size} bytes")
    pixels = np.ascontiguousarray(data.reshape(height, step)[:, :row])
    # 16 bits stay grey, with the byte order of the message
    if depth.itemsize == 2:
        big = bool(getattr(message, "is_bigendian", 0))
        return pixels.view(depth.newbyteorder(">" if big else "<")).reshape(height, width)
    pixels = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    code = _TO_RGB[encoding]
    return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code))


def read_calibration(message: Any) -> Calibration:
    """Return the calibration of a CameraInfo or CameraCalibration.

    Raises:
        InputError: it is none, or its lens is not OpenCV's with five coefficients.
    """
    K = np.array(message.k if hasattr(message, "k") else message.K, np.float64)
    dist = np.array(message.d if hasattr(message, "d") else message.D, np.float64)
    model = message.distortion_model
    if K.size != 9 or not np.isfinite(K).all() or K[0] <= 0 or K[4] <= 0:
        raise InputError(f"a camera without a calibration (K is {K.tolist()})")
    # Without coefficients an equidistant lens is still a fisheye, so its name alone decides.
    if model not in ("plumb_bob", "rational_polynomial", "") or dist[5:].any():
        raise InputError(f"lenses of the model {model!r} are not read; undistort the images first")
    K = K.reshape(3, 3)
    # Pixel centres at +0.5
    K[:2, 2] += 0.5
    five = np.zeros(5)
    five[: min(len(dist), 5)] = dist[:5]
    return Calibration(K, five, (int(message.height), int(message.width)))


def read_cloud(message: Any) -> Cloud:
    """Return the points of a PointCloud2 or PointCloud that are finite.

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
    return Cloud(
        xyz[kept],
        None if intensity is None else intensity.astype(np.float64),
        column(_TIMES),
        None if channel is None else channel.astype(np.float64),
    )


# Fields of arbitrary types at arbitrary offsets, as numpy's structured arrays
def _cells(message: Any) -> np.ndarray:
    """Return the points of a cloud as a structured array."""
    if hasattr(message, "point_step"):
        step, count = int(message.point_step), int(message.width) * int(message.height)
        order = ">" if message.is_bigendian else "<"
        kinds = {one.name: (_NUMPY_OF_ROS.get(int(one.datatype)), int(one.offset)) for one in message.fields}
    else:
        step, order = int(message.point_stride), "<"
        count = len(message.data) // step if step else 0
        kinds = {one.name: (_NUMPY_OF_FOXGLOVE.get(int(one.type)), int(one.offset)) for one in message.fields}
    data = bytes(message.data)
    if not kinds or step <= 0 or len(data) < count * step:
        raise InputError(f"a point cloud of {count} points of {step} bytes has {len(data)} bytes")
    for name, (kind, offset) in kinds.items():
        if kind is None or offset < 0 or offset + np.dtype(kind).itemsize > step:
            raise InputError(f"the field {name!r} of a point cloud does not fit into its points")
    layout = {
        "names": list(kinds),
        "formats": [f"{order}{kind}" for kind, _ in kinds.values()],
        "offsets": [offset for _, offset in kinds.values()],
        "itemsize": step,
    }
    return np.frombuffer(data, np.dtype(layout), count)  # type: ignore[call-overload]


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
