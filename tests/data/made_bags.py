"""Small bags of a vehicle that drives at 10 m/s and turns, written by the libraries that write real ones."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from foredrive.data.formats.bag_proposal import propose_topics
from foredrive.data.formats.bag_topics import topics_file
from foredrive.data.formats.convert import convert
from foredrive.data.logs import Log
from foredrive.data.notices import read_notices

START_NS = 1_700_000_000_000_000_000
SPEED_MPS, TURN_RADPS, FRAMES, PERIOD_NS = 10.0, 0.5, 5, 100_000_000
LIDAR_M, CAMERA_M = (1.0, 0.0, 1.8), (1.5, 0.2, 1.4)
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
"""x y z w of a camera that looks ahead: z ahead, x to the right."""
POINTS = np.array([[10.0, 1.0, -1.8, 60.0, 0, 0], [5.0, -2.0, -0.5, 255.0, 1, 50_000_000]])
"""x y z intensity ring t: the second point is measured 50 ms after the stamp."""
COLOUR = (200, 30, 10)


def pose_at(t_s: float) -> np.ndarray:
    """The vehicle's pose at a time since the start: on a circle, ahead along x at first."""
    yaw, radius_m = TURN_RADPS * t_s, SPEED_MPS / TURN_RADPS
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = radius_m * np.sin(yaw), radius_m * (1 - np.cos(yaw))
    return T


class Messages:
    """Builds messages of one version of ROS."""

    def __init__(self, version: int) -> None:
        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.LATEST)
        if version == 1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self._types = self.store.types

    def make(self, kind: str, /, **values: Any) -> Any:
        return self._types[kind](**values)

    def header(self, t_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        more = {"seq": 0} if self.version == 1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **more)

    def transform(self, t_ns: int, parent: str, child: str, at: Any, turn: Any) -> Any:
        moved = self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", x=at[0], y=at[1], z=at[2]),
            rotation=self._turn(turn),
        )
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(t_ns, parent),
            child_frame_id=child,
            transform=moved,
        )

    def _turn(self, q: Any) -> Any:
        return self.make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3])

    def odometry(self, t_ns: int) -> Any:
        t_s = (t_ns - START_NS) * 1e-9
        x, y, z = pose_at(t_s)[:3, 3].tolist()
        half = 0.5 * TURN_RADPS * t_s
        none = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(t_ns, "odom"),
            child_frame_id="base_link",
            pose=self.make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self.make(
                    "geometry_msgs/msg/Pose",
                    position=self.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
                    orientation=self._turn((0.0, 0.0, float(np.sin(half)), float(np.cos(half)))),
                ),
                covariance=np.zeros(36),
            ),
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self.make("geometry_msgs/msg/Twist", linear=none, angular=none),
                covariance=np.zeros(36),
            ),
        )

    def cloud(self, t_ns: int) -> Any:
        kinds = [("x", 7, 0), ("y", 7, 4), ("z", 7, 8), ("intensity", 7, 12), ("ring", 4, 16), ("t", 6, 20)]
        cells = np.zeros(
            len(POINTS),
            np.dtype(
                {
                    "names": [name for name, *_ in kinds],
                    "formats": ["<f4"] * 4 + ["<u2", "<u4"],
                    "offsets": [offset for *_, offset in kinds],
                    "itemsize": 24,
                }
            ),
        )
        for column, (name, *_) in enumerate(kinds):
            cells[name] = POINTS[:, column]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(t_ns, "lidar"),
            height=1,
            width=len(POINTS),
            fields=[
                self.make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=kind, count=1)
                for name, kind, offset in kinds
            ],
            is_bigendian=False,
            point_step=24,
            row_step=24 * len(POINTS),
            data=np.frombuffer(cells.tobytes(), np.uint8),
            is_dense=True,
        )

    def image(self, t_ns: int) -> Any:
        pixels = np.zeros((16, 32, 3), np.uint8)
        pixels[:] = COLOUR[::-1]  # bgr
        padded = np.concatenate([pixels.reshape(16, 96), np.zeros((16, 4), np.uint8)], axis=1)
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(t_ns, "camera_optical"),
            height=16,
            width=32,
            encoding="bgr8",
            is_bigendian=0,
            step=100,
            data=padded.reshape(-1),
        )

    def compressed(self, t_ns: int) -> Any:
        out = io.BytesIO()
        Image.new("RGB", (32, 16), COLOUR).save(out, "PNG")
        return self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(t_ns, "camera_optical"),
            format="png",
            data=np.frombuffer(out.getvalue(), np.uint8),
        )

    def info(self, t_ns: int, **values: Any) -> Any:
        names = "DKRP" if self.version == 1 else "dkrp"
        K = np.array([50.0, 0, 15.5, 0, 50, 7.5, 0, 0, 1])
        arrays = dict(zip(names, (np.zeros(5), K, np.eye(3).reshape(-1), np.zeros(12)), strict=True))
        described = {
            "header": self.header(t_ns, "camera_optical"),
            "height": 16,
            "width": 32,
            "distortion_model": "plumb_bob",
            "binning_x": 0,
            "binning_y": 0,
            "roi": self.make(
                "sensor_msgs/msg/RegionOfInterest",
                x_offset=0,
                y_offset=0,
                height=0,
                width=0,
                do_rectify=False,
            ),
        }
        return self.make("sensor_msgs/msg/CameraInfo", **(described | arrays | values))

    def tf(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    def recording(self) -> list[tuple[str, int, Any]]:
        """Topic, time and message of all that is recorded. Poses come at 50 Hz and images 20 ms late."""
        static = [
            self.transform(START_NS, "base_link", "lidar", LIDAR_M, (0.0, 0.0, 0.0, 1.0)),
            self.transform(START_NS, "base_link", "camera_optical", CAMERA_M, OPTICAL),
        ]
        found: list[tuple[str, int, Any]] = [("/tf_static", START_NS, self.tf(*static))]
        for k in range(-2, 5 * FRAMES + 3):
            t_ns = START_NS + k * PERIOD_NS // 5
            found.append(("/odom", t_ns, self.odometry(t_ns)))
        for k in range(FRAMES):
            t_ns = START_NS + k * PERIOD_NS
            found.append(("/lidar/points", t_ns, self.cloud(t_ns)))
            late = t_ns + 20_000_000
            found.append(("/front/camera_info", late, self.info(late)))
            if k != 2:  # one image is lost
                found.append(("/front/image_raw", late, self.image(late)))
                found.append(("/front/image_raw/compressed", late, self.compressed(late)))
        return sorted(found, key=lambda each: each[1])


def write_ros1(
    path: Path, compression: Writer1.CompressionFormat | None = None, chunk_bytes: int | None = None
) -> None:
    messages = Messages(1)
    file = Writer1(path)
    if compression is not None:
        file.set_compression(compression)
    if chunk_bytes is not None:
        file.chunk_threshold = chunk_bytes
    with file as writer:
        opened: dict[str, Any] = {}
        for topic, t_ns, message in messages.recording():
            kind = message.__msgtype__
            if topic not in opened:
                opened[topic] = writer.add_connection(topic, kind, typestore=messages.store)
            writer.write(opened[topic], t_ns, messages.store.serialize_ros1(message, kind))


Recording = list[tuple[str, int, Any]]
Change = Callable[[Messages, Recording], Recording]


def write_ros2(
    path: Path,
    storage: StoragePlugin = StoragePlugin.SQLITE3,
    skip: tuple[str, ...] = (),
    change: Change = lambda made, recording: recording,
) -> None:
    """Write the recording, without the topics of `skip`, as `change` makes it."""
    messages = Messages(2)
    with Writer2(path, version=9, storage_plugin=storage) as writer:
        opened: dict[str, Any] = {}
        for topic, t_ns, message in change(messages, messages.recording()):
            if topic in skip:
                continue
            kind = message.__msgtype__
            if topic not in opened:
                opened[topic] = writer.add_connection(topic, kind, typestore=messages.store)
            writer.write(opened[topic], t_ns, messages.store.serialize_cdr(message, kind))


def converted(folder: Path, change: Change, **topics: object) -> tuple[Log, list[str]]:
    """Return the log of a changed recording, and its notices."""
    bag = folder / "drive"
    write_ros2(bag, change=change)
    propose_topics(bag, topics_file(bag))
    if topics:
        written = yaml.safe_load(topics_file(bag).read_text())
        topics_file(bag).write_text(yaml.safe_dump(written | topics))
    (path,) = convert(bag, "rosbag", folder / "out")
    return Log(path), read_notices(path.folder)


def write_mcap_of_ros1(path: Path) -> None:
    """Write the recording as `mcap convert` does from a ROS 1 bag, in chunks of some messages."""
    from mcap.writer import Writer

    messages = Messages(1)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4096)
        writer.start(profile="ros1")
        channels: dict[str, int] = {}
        for topic, t_ns, message in messages.recording():
            kind = message.__msgtype__
            if topic not in channels:
                schema = writer.register_schema(kind.replace("/msg/", "/"), "ros1msg", b"")
                channels[topic] = writer.register_channel(topic, "ros1", schema)
            data = bytes(messages.store.serialize_ros1(message, kind))
            writer.add_message(channels[topic], t_ns, data, t_ns)
        writer.finish()
