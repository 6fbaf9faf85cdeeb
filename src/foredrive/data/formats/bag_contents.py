"""Topics and messages of a bag, and the decoders of ROS messages.

ROS messages are read by the definitions that come with `rosbags`, not by those embedded in a bag, from which
`rosbags` would generate code.
"""

import functools
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

KINDS = {
    "sensor_msgs/msg/Image": "image",
    "sensor_msgs/msg/CompressedImage": "image",
    "sensor_msgs/msg/CameraInfo": "info",
    "sensor_msgs/msg/PointCloud2": "points",
    "tf2_msgs/msg/TFMessage": "tf",
    "tf/msg/tfMessage": "tf",
    "nav_msgs/msg/Odometry": "odometry",
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose",
    "foxglove.RawImage": "image",
    "foxglove.CompressedImage": "image",
    "foxglove.CameraCalibration": "info",
    "foxglove.PointCloud": "points",
    "foxglove.FrameTransform": "tf",
    "foxglove.FrameTransforms": "tf",
    "foxglove.PoseInFrame": "pose",
}
"""Kind of sensor data by message type. Other types are left out."""


@dataclass(frozen=True)
class Message:
    """One message of a bag, not yet decoded."""

    topic: str
    recorded_s: float
    """Time at which the recorder received it, s. The time of measurement is in its content."""
    decode: Callable[[], Any]
    """Returns its content. Raises an error of any class if the message is damaged."""


@dataclass(frozen=True)
class Topic:
    """One topic of a bag."""

    name: str
    type: str
    count: int
    unread: str | None = None
    """Reason why its messages cannot be decoded, or None if they can."""

    @property
    def kind(self) -> str | None:
        """Return its kind of sensor data, or None for a type that is not read."""
        return KINDS.get(self.type) if self.unread is None else None


@dataclass(frozen=True)
class Bag:
    """An open bag."""

    topics: dict[str, Topic]
    read: Callable[[Collection[str]], Iterator[Message]]
    """Yields the messages of the named topics in the order of the bag."""


def joined_topics(parts: Iterable[Topic]) -> dict[str, Topic]:
    """Return the topics by name. Connections and files that have the same topic are counted together."""
    topics: dict[str, Topic] = {}
    for part in parts:
        before = topics.get(part.name)
        if before is not None and before.count:
            topics[part.name] = Topic(part.name, before.type, before.count + part.count, before.unread)
        else:
            topics[part.name] = part
    return topics


@functools.cache
def ros_decoder(version: Literal[1, 2]) -> Callable[[bytes, str], Any]:
    """Return the function that decodes a message of ROS 1 or 2 from its bytes and type."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.LATEST)
    if version == 1:  # rosbags' definitions of ROS 1 lack these
        for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
            types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return types.deserialize_ros1 if version == 1 else types.deserialize_cdr


def ros_type(name: str) -> str:
    """Return the name of a ROS type as ROS 2 writes it: PACKAGE/msg/NAME."""
    package, *middle, last = name.split("/")
    return f"{package}/msg/{last}" if not middle and package != last else name
