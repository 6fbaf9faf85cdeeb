"""Stamps, transforms and calibrations of a bag, from a first pass before images and sweeps are decoded."""

import functools
import itertools
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int64

from foredrive.data.formats.bag_clocks import Stream, on_one_clock
from foredrive.data.formats.bag_contents import Bag, Message
from foredrive.data.formats.bag_messages import (
    Placed,
    is_static,
    read_calibration,
    read_placed,
    stamp_us,
)
from foredrive.data.formats.bag_topics import BagTopics, is_rectified_camera
from foredrive.data.formats.frame_tree import FrameTree
from foredrive.data.formats.guard import PartReader
from foredrive.errors import InputError


class Stamp(NamedTuple):
    """Time of one message."""

    number: int
    """Position of the message in its topic."""
    t_us: int
    """Time of measurement."""
    recorded_us: int
    """Time at which the recorder received it."""


@dataclass
class BagIndex:
    """Stamps, transforms and calibrations of a bag."""

    posed: list[Placed] = field(default_factory=list)
    """Poses of the ego frame, from the topic of poses."""
    placed: list[Placed] = field(default_factory=list)
    """All transforms."""
    stamps: dict[str, list[Stamp]] = field(default_factory=dict)
    """Stamps of the readable messages, by topic."""
    first: dict[str, Any] = field(default_factory=dict)
    """First readable message of each topic of images, points and calibrations."""

    def stamps_us(self, topic: str) -> Int64[np.ndarray, "N"]:
        """Return the stamps of a topic in the order of the bag."""
        return np.array([stamp.t_us for stamp in self.stamps[topic]], np.int64)


def index_bag(bag: Bag, topics: BagTopics) -> BagIndex:
    """Read the stamps, transforms and calibrations of a bag, with all stamps on one clock (`bag_clocks`).

    Raises:
        InputError: no message of a topic can be read, or stamps are not set and there is no clock.
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
        if topic in infos and topic in index.first:
            continue
        read = functools.partial(_read_message, message, index, topics, number)
        readers[topic](f"message {number}, recorded at {message.recorded_s:.3f} s", read)
    # Every wanted topic needs at least one readable message
    for topic in sorted(names - tf):
        readers[topic].check()
        if not numbers[topic]:
            raise InputError(f"{topic}: none of its messages can be read; the recording is damaged")
    _set_on_one_clock(index, topics.pose)
    return index


def _set_on_one_clock(index: BagIndex, pose: str | None) -> None:
    """Compare the clocks of images, points, poses and transforms, and correct their stamps."""
    placed_by_name = {} if pose is None or not index.posed else {pose: index.posed}
    by_child: dict[str, list[Placed]] = {}
    for one in index.placed:
        if not one.fixed:
            by_child.setdefault(f"transforms of {one.child}", []).append(one)
    # A single transform holds for all times
    placed_by_name |= {name: placed for name, placed in by_child.items() if len(placed) > 1}
    rows: dict[str, list[Stamp] | list[Placed]] = {**index.stamps, **placed_by_name}
    streams = {
        name: Stream(
            *(np.array([getattr(row, key) for row in many], np.int64) for key in ("t_us", "recorded_us"))
        )
        for name, many in rows.items()
    }
    single = [placed[0] for placed in by_child.values() if len(placed) == 1]
    still = [one for one in index.placed if one.fixed]
    index.placed = [*still, *single]
    for name, clock in on_one_clock(streams).items():
        times_us = clock.t_us.tolist()
        if name in index.stamps:
            stamps = [
                stamp._replace(t_us=t_us) for stamp, t_us in zip(index.stamps[name], times_us, strict=True)
            ]
            index.stamps[name] = list(itertools.compress(stamps, clock.kept))
            continue
        placed = [replace(one, t_us=t_us) for one, t_us in zip(placed_by_name[name], times_us, strict=True)]
        kept = list(itertools.compress(placed, clock.kept))
        if name == pose:
            index.posed = kept
        else:
            index.placed += kept


def _read_message(message: Message, index: BagIndex, topics: BagTopics, number: int) -> None:
    """Add the content of one message to an index."""
    topic, content = message.topic, message.decode()
    recorded_us = round(message.recorded_s * 1e6)
    sensed = topic in {camera.images for camera in topics.cameras.values()}
    if sensed or (topics.lidar is not None and topic == topics.lidar.topic):
        index.stamps.setdefault(topic, []).append(Stamp(number, stamp_us(content), recorded_us))
        index.first.setdefault(topic, content)
    elif topic == topics.pose:
        index.posed += [replace(one, recorded_us=recorded_us) for one in read_placed(content)]
    elif any(topic == camera.info for camera in topics.cameras.values()):
        for camera in topics.cameras.values():
            if camera.info == topic:
                read_calibration(content, is_rectified_camera(camera))
        index.first[topic] = content
    else:
        fixed = is_static(topic)
        index.placed += [replace(one, recorded_us=recorded_us, fixed=fixed) for one in read_placed(content)]


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
            at_us = np.array([one.t_us])
            T_child_ego[child] = np.eye(4) if same else tree.between(child, topics.ego_frame, at_us)[0]
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
