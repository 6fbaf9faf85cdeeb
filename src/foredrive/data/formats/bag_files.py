"""Messages of ROS 1 bags, ROS 2 bags and MCAP files of ROS or Foxglove messages.

ROS messages are read by the definitions that come with `rosbags`, not by those embedded in a bag, from which
`rosbags` would generate code. Foxglove's protocol buffers are read by `mcap-protobuf-support`.
"""

import contextlib
import functools
import importlib.util
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foredrive.errors import InputError
from foredrive.plain_yaml import read_yaml

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
    """One message as it lies in a bag."""

    topic: str
    recorded_s: float
    """When the recorder received it, s. The stamp of what it measured is in its content."""
    decode: Callable[[], Any]
    """Returns its content; raises an error of any class if the message is damaged."""


@dataclass(frozen=True)
class Topic:
    """One topic of a bag."""

    name: str
    type: str
    count: int

    @property
    def kind(self) -> str | None:
        """Return what its messages hold, or None for a type that is not read."""
        return KINDS.get(self.type)


@dataclass(frozen=True)
class Bag:
    """An open bag."""

    topics: dict[str, Topic]
    read: Callable[[Collection[str]], Iterator[Message]]
    """Yields the messages of the named topics in the order of the bag."""


@contextlib.contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a .bag, a ROS 2 bag (its folder, .db3 or .mcap), or an .mcap of Foxglove's messages.

    Raises:
        InputError: the packages are not installed, or it is none of these.
    """
    for package in ("rosbags", "mcap"):
        if importlib.util.find_spec(package) is None:
            raise InputError(f"bags need the package {package}: pip install 'foredrive[bags]'")
    # A ROS 2 bag is a folder with its metadata, or a single file
    ros2_folder = path.is_dir() and (path / "metadata.yaml").is_file()
    if not ros2_folder and path.suffix not in (".bag", ".db3", ".mcap"):
        raise InputError(f"{path}: neither a .bag, .db3 or .mcap nor the folder of a ROS 2 bag")
    if ros2_folder:  # the reader of rosbags would follow aliases of aliases for ever
        read_yaml(path / "metadata.yaml", "the metadata of a bag")
    with _open_foxglove(path) if _is_foxglove(path) else _open_ros(path) as bag:
        yield bag


@contextlib.contextmanager
def _open_ros(path: Path) -> Iterator[Bag]:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    is_ros1 = path.suffix == ".bag"
    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    if is_ros1:  # rosbags' definitions of ROS 1 lack these
        for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
            types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    decode = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
    with Reader1(path) if is_ros1 else Reader2(path) as reader:
        topics = {
            name: Topic(name, info.msgtype or "", info.msgcount) for name, info in reader.topics.items()
        }

        def read(names: Collection[str]) -> Iterator[Message]:
            # Only connections of the named topics are read
            wanted = [one for one in reader.connections if one.topic in names]
            for connection, t_ns, data in reader.messages(connections=wanted) if wanted else ():
                content = functools.partial(decode, data, connection.msgtype)
                yield Message(connection.topic, t_ns * 1e-9, content)

        yield Bag(topics, read)


def _is_foxglove(path: Path) -> bool:
    """Return whether an MCAP file has protocol buffers."""
    if path.suffix != ".mcap":
        return False
    from mcap.reader import make_reader

    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        return summary is not None and any(one.encoding == "protobuf" for one in summary.schemas.values())


@contextlib.contextmanager
def _open_foxglove(path: Path) -> Iterator[Bag]:
    if importlib.util.find_spec("mcap_protobuf") is None:
        raise InputError("Foxglove's MCAP needs mcap-protobuf-support: pip install 'foredrive[bags]'")
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    if summary is None:
        raise InputError(f"{path}: an MCAP file without a summary; it was not closed")
    counts = Counter(summary.statistics.channel_message_counts if summary.statistics else {})
    topics = {
        one.topic: Topic(one.topic, summary.schemas[one.schema_id].name, counts[one.id])
        for one in summary.channels.values()
        if one.schema_id in summary.schemas
    }

    decoders = DecoderFactory()

    def decoded(schema: Any, channel: Any, data: bytes) -> Any:
        decoder = decoders.decoder_for(channel.message_encoding, schema)
        if decoder is None:
            raise InputError(f"messages of encoding {channel.message_encoding!r} are not read")
        return decoder(data)

    def read(names: Collection[str]) -> Iterator[Message]:
        with path.open("rb") as opened:
            reader = make_reader(opened)
            for schema, channel, message in reader.iter_messages(topics=list(names)) if names else ():
                content = functools.partial(decoded, schema, channel, message.data)
                yield Message(channel.topic, message.log_time * 1e-9, content)

    yield Bag(topics, read)
