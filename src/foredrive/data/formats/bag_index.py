"""A first pass over a bag: stamps, transforms and calibrations, before any image or sweep is decoded."""

import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Int64

from foredrive.data.formats.bag_files import Bag, Message
from foredrive.data.formats.bag_messages import Calibration, Placed, read_calibration, read_placed, stamp_us
from foredrive.data.formats.bag_topics import BagTopics
from foredrive.data.formats.frame_tree import FrameTree
from foredrive.data.formats.guard import PartReader


@dataclass
class BagIndex:
    """Stamps, transforms and calibrations of a bag."""

    posed: list[Placed] = field(default_factory=list)
    """Poses of the ego frame, from the topic of poses."""
    placed: list[Placed] = field(default_factory=list)
    """All transforms."""
    stamps: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    """Number in its topic and stamp (µs) of each readable message, by topic."""
    first: dict[str, Any] = field(default_factory=dict)
    """First readable message by topic."""
    calibrations: dict[str, Calibration] = field(default_factory=dict)

    def stamps_us(self, topic: str) -> Int64[np.ndarray, "N"]:
        """Return the stamps of a topic in the order of the bag."""
        return np.array([t_us for _, t_us in self.stamps[topic]], np.int64)


def index_bag(bag: Bag, topics: BagTopics) -> BagIndex:
    """Read the stamps, transforms and calibrations of a bag.

    Raises:
        InputError: no message of a topic can be read.
    """
    index = BagIndex()
    # Cameras, lidar and poses by topic; transforms from all topics that have them
    infos = {camera.info for camera in topics.cameras.values() if camera.info is not None}
    sensed = {camera.images for camera in topics.cameras.values()}
    sensed |= {topics.lidar.topic} if topics.lidar else set()
    tf = {one.name for one in bag.topics.values() if one.kind == "tf"}
    names = infos | sensed | tf | ({topics.pose} if topics.pose else set())
    readers = {name: PartReader(name, "messages") for name in names}
    numbers = dict.fromkeys(names, 0)
    for message in bag.read(names):
        topic, number = message.topic, numbers[message.topic]
        numbers[topic] += 1
        # One calibration is enough for a camera
        if topic in infos and topic in index.calibrations:
            continue
        read = functools.partial(_read_message, message, index, topics, number)
        readers[topic](f"message {number}, recorded at {message.recorded_s:.3f} s", read)
    # Every wanted topic needs at least one readable message
    for topic in sorted(names - tf):
        readers[topic].check()
    return index


def _read_message(message: Message, index: BagIndex, topics: BagTopics, number: int) -> None:
    """Add the content of one message to an index."""
    topic, content = message.topic, message.decode()
    sensed = topic in {camera.images for camera in topics.cameras.values()}
    if sensed or (topics.lidar is not None and topic == topics.lidar.topic):
        index.stamps.setdefault(topic, []).append((number, stamp_us(content)))
        index.first.setdefault(topic, content)
    elif topic == topics.pose:
        index.posed += list(read_placed(content))
    elif any(topic == camera.info for camera in topics.cameras.values()):
        index.calibrations[topic] = read_calibration(content)
    else:
        index.placed += list(read_placed(content))


def transforms(index: BagIndex, topics: BagTopics) -> list[Placed]:
    """Return the transforms of a bag. Those of the vehicle come from the topic of poses, if there is one.

    Raises:
        InputError: the poses are those of a frame that no transform connects to the ego frame.
    """
    if topics.pose is None:
        return index.placed
    tree = FrameTree(index.placed)
    posed = []
    # Transform from the posed frame to the ego frame, looked up once for each frame
    T_child_ego: dict[str, np.ndarray] = {}
    for one in index.posed:
        child = one.child or topics.ego_frame
        if child not in T_child_ego:
            same = child == topics.ego_frame
            T_child_ego[child] = np.eye(4) if same else tree.between(child, topics.ego_frame, one.t_us)
        T_parent_ego = one.T_parent_child @ T_child_ego[child]
        posed.append(Placed(one.parent, topics.ego_frame, one.t_us, T_parent_ego))
    parents = {one.parent for one in posed}
    others = [
        # Transforms of the ego frame from elsewhere would contradict the poses
        one
        for one in index.placed
        if one.child != topics.ego_frame and not (one.parent == topics.ego_frame and one.child in parents)
    ]
    return [*posed, *others]
