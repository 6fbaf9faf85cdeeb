"""A proposal of the YAML of a bag: which topics are cameras, lidar and poses."""

import dataclasses
import itertools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from foredrive.data.formats.bag_contents import Bag, Topic
from foredrive.data.formats.bag_files import open_bag
from foredrive.data.formats.bag_images import depth_fault, is_rectified, read_pixels
from foredrive.data.formats.bag_messages import (
    Placed,
    frame_of,
    is_static,
    read_calibration,
    read_cloud,
    read_placed,
    stamp_us,
    time_unit,
)
from foredrive.data.formats.bag_topics import BagTopics, CameraTopics, LidarTopic
from foredrive.data.formats.frame_tree import FrameTree
from foredrive.data.formats.guard import DEFAULT_PERIOD_S
from foredrive.data.notices import collecting
from foredrive.errors import InputError
from foredrive.files import atomic_path

T = TypeVar("T")
_EGO_NAMES = ("base_link", "base_footprint", "ego", "ego_vehicle", "vehicle", "imu_link", "imu")
_WORLD_NAMES = ("map", "odom", "world", "global", "earth", "utm")
_RANGE_IMAGES = 10
"""Images whose values are looked at for the range of a camera with 16 bits."""
_TRIED_IMAGES = 3
"""A topic of which none of the first images can be read is left out."""
_MADE_CLOUD = re.compile(
    "regist|map|deskew|undistort|filter|ground|obstacle|segment|cluster|crop|downsampl|voxel|fused|merged|concat"
    "|accumul|depth|stereo|camera|color",
    re.IGNORECASE,
)
"""Words in the names of clouds that a program made of a lidar's sweeps or of images."""


def propose_topics(bag: Path, file: Path) -> str:
    """Write a YAML of what a bag holds, and return it. An existing file is not replaced.

    Its comments list all topics, and say of those with images, points or poses that are not used why.

    Raises:
        InputError: the file is there, or the bag cannot be read or has no images and points.
    """
    if file.exists():
        raise InputError(f"{file}: is there already; remove it to propose topics anew")
    # Faults of single messages are collected and not written: the conversion names them
    with open_bag(bag) as opened, collecting():
        proposal = _Proposal(opened)
        topics = proposal.topics(bag)
        lines = [
            f"# {topic.name}: {topic.type}, {topic.count} messages{proposal.reason(topic)}"
            for topic in sorted(opened.topics.values(), key=lambda one: one.name)
        ]
    text = "\n".join(
        [
            f"# Topics of {bag.name}, proposed by foredrive convert rosbag; all topics:",
            *lines,
            yaml.safe_dump(topics.model_dump(exclude_defaults=True), sort_keys=False),
            *proposal.hints,
        ]
    )
    with atomic_path(file) as temporary:
        temporary.write_text(text)
    return text


class _Proposal:
    """The use of a bag's topics, found by their types, names and first messages."""

    def __init__(self, bag: Bag) -> None:
        self._bag = bag
        self._left_out: dict[str, str] = {}
        self._tree = FrameTree([])
        self.hints: list[str] = []
        """Comments with entries that a user may complete."""

    def reason(self, topic: Topic) -> str:
        """Return why a topic is left out, for behind its name."""
        if topic.kind is None:
            return f"; {topic.unread or 'messages of this type are not read'}"
        return f"; left out: {self._left_out[topic.name]}" if topic.name in self._left_out else ""

    def topics(self, path: Path) -> BagTopics:
        """Return the proposal.

        Raises:
            InputError: there are neither images nor points.
        """
        # Topics by kind of data, those without messages left out
        by_kind: dict[str, list[Topic]] = {}
        for topic in self._bag.topics.values():
            if topic.kind is not None and topic.count:
                by_kind.setdefault(topic.kind, []).append(topic)
        if not {"image", "points"} & set(by_kind):
            names = ", ".join(f"{name}{self.reason(one)}" for name, one in self._bag.topics.items()) or "none"
            raise InputError(f"{path}: no topic with images or points; there are: {names}")
        # Poses first: they decide about the frames of the world and the vehicle
        world, ego, pose = self._poses(by_kind)
        lidar = self._lidar(by_kind.get("points", []), world, ego)
        return BagTopics(
            name=_plain(path.stem),
            world_frame=world,
            ego_frame=ego,
            pose=pose,
            cameras=dict(self._cameras(by_kind.get("image", []), by_kind.get("info", []))),
            lidar=lidar,
        )

    def _first(self, topic: str, count: int = 1) -> list[Any]:
        """Return the first messages of a topic that can be decoded."""
        contents = (_attempt(message.decode) for message in self._bag.read([topic]))
        return list(itertools.islice((content for content in contents if content is not None), count))

    def _poses(self, by_kind: dict[str, list[Topic]]) -> tuple[str, str, str | None]:
        """Return the frames of the world and the vehicle, and the topic of poses if one is needed.

        The frames are those of the usual names, else the first that moves. A topic of poses in a frame that
        moves with the vehicle tells nothing of its path.
        """
        # All transforms of the bag
        tf: list[Placed] = []
        for message in self._bag.read([one.name for one in by_kind.get("tf", [])]):
            content = _attempt(message.decode)
            tf += [] if content is None else _attempt(_placed, content, is_static(message.topic)) or []
        # First pose of each topic that has poses
        candidates: dict[str, Placed] = {}
        for topic in [*by_kind.get("odometry", []), *by_kind.get("pose", [])]:
            for content in self._first(topic.name):
                placed = _attempt(_placed, content)
                candidates |= {topic.name: placed[0]} if placed else {}
        stated = [*tf, *(one for one in candidates.values() if one.child)]
        tree = self._tree = FrameTree(stated)
        # The vehicle's frame by its usual names, in any case
        names = {name.lower(): name for name in sorted(tree.frames)}
        ego = next((names[name] for name in _EGO_NAMES if name in names), None)
        ego = ego or (stated[0].child if stated else _EGO_NAMES[0])
        pose = None
        # A pose in a frame that moves with the vehicle does not tell its path
        for topic_name, one in candidates.items():
            if one.parent == ego or tree.is_below(one.parent, ego):
                self._left_out[topic_name] = f"its frame {one.parent} moves with {ego}"
            elif pose is None:
                pose = topic_name
            else:
                self._left_out[topic_name] = f"poses are those of {pose}"
        if pose is not None:
            return candidates[pose].parent, ego, pose
        # Without a topic of poses, the world is the usual frame above the vehicle
        above = [name for name in _WORLD_NAMES if name in names and tree.is_below(ego, names[name])]
        world = names[above[0]] if above else (stated[0].parent if stated else _WORLD_NAMES[0])
        return world, ego, None

    def _cameras(self, images: list[Topic], infos: list[Topic]) -> Iterator[tuple[str, CameraTopics]]:
        """Yield a camera for each topic of images that has a calibration of its own."""
        used: dict[str, str] = {}
        names: set[str] = set()
        frames = {topic.name: [frame_of(content) for content in self._first(topic.name)] for topic in infos}
        # Compressed images come first: of two topics of one camera, they are smaller
        for topic in sorted(images, key=lambda one: (not one.type.endswith("CompressedImage"), one.name)):
            first = self._first(topic.name, _TRIED_IMAGES)
            fault = self._image_fault(topic.name, first)
            if fault is not None:
                self._left_out[topic.name] = fault
                continue
            frame = [frame_of(first[0])]
            info = _calibration_of(topic.name, frame, frames)
            rectified = is_rectified(topic.name)
            lens = self._lens_fault(info, rectified)
            name = _camera_name(topic.name, names)
            if info is None:
                self._left_out[topic.name] = "it has no CameraInfo"
                self.hints += [
                    f"# {topic.name} has no CameraInfo. It is a camera with a calibration as of one:",
                    "# cameras:",
                    f"#   {name}: {{images: {topic.name}, intrinsics: {{fx: , fy: , cx: , cy: }}}}",
                ]
            elif lens is not None:
                self._left_out[topic.name] = lens
            elif info in used:
                self._left_out[topic.name] = f"the same camera as {used[info]}"
            else:
                used[info] = topic.name
                names.add(name)
                yield (
                    name,
                    CameraTopics(
                        images=topic.name,
                        info=info,
                        value_range=self._range(topic.name),
                        rectified=True if rectified else None,
                    ),
                )

    def _image_fault(self, topic: str, first: list[Any]) -> str | None:
        """Return why images are none of a camera, or cannot be read, or None."""
        if not first:
            return "none of its messages can be read"
        faults = [_fault(read_pixels, content) for content in first]
        return depth_fault(topic, first[0]) or (None if None in faults else faults[0])

    def _lens_fault(self, info: str | None, rectified: bool) -> str | None:
        """Return why the lens of a CameraInfo cannot be read, or None if it can."""
        first = [] if info is None else self._first(info)
        return next((_fault(read_calibration, content, rectified) for content in first), None)

    def _range(self, topic: str) -> tuple[float, float] | None:
        """Return the smallest and the largest value of some images of 16 bits, or None for others."""
        read = (_attempt(read_pixels, content) for content in self._first(topic, _RANGE_IMAGES))
        grey = [pixels for pixels in read if pixels is not None]
        if not grey or grey[0].dtype == np.uint8:
            return None
        return float(min(pixels.min() for pixels in grey)), float(max(pixels.max() for pixels in grey))

    def _lidar(self, topics: list[Topic], world: str, ego: str) -> LidarTopic | None:
        """Return the raw lidar with most messages, or None without points. A log has one lidar.

        Clouds that somebody has registered in the world, or made of others, come last.
        """
        ranked = []
        for topic in topics:
            first = self._first(topic.name)
            if not first:
                self._left_out[topic.name] = "none of its messages can be read"
                continue
            frame = frame_of(first[0])
            registered = self._is_above(frame, ego, world)
            connected = frame == ego or self._tree.is_below(frame, ego)
            made = bool(_MADE_CLOUD.search(topic.name))
            count = _attempt(lambda message: len(read_cloud(message).xyz_m), first[0]) or 0
            ranked.append(((registered, not connected, made, -topic.count, -count, topic.name), topic))
        if not ranked:
            if topics:
                raise InputError(f"{topics[0].name}: none of its messages can be read")
            return None
        ranked.sort(key=lambda row: row[0])
        for rank, topic in ranked[1:]:
            self._left_out[topic.name] = "registered in the world" if rank[0] else "one lidar is read"
        return self._lidar_topic(ranked[0][1], registered=ranked[0][0][0])

    def _is_above(self, frame: str, ego: str, world: str) -> bool:
        """Return whether a frame stays where the world is, and does not move with the vehicle."""
        if frame == ego or self._tree.is_below(frame, ego):
            return False
        return frame == world or self._tree.is_below(ego, frame) or self._tree.is_below(frame, world)

    def _lidar_topic(self, topic: Topic, registered: bool) -> LidarTopic:
        first = self._first(topic.name, 2)
        cloud = read_cloud(first[0])
        largest = 0.0 if cloud.intensity is None or not cloud.intensity.size else float(cloud.intensity.max())
        # The usual scale of intensity that holds the largest value
        scale = next((scale for scale in (1.0, 255.0, 65_535.0) if largest <= scale), largest)
        stamps_us = [stamp_us(content) for content in first]
        # Two sweeps give the period
        period_s = (stamps_us[-1] - stamps_us[0]) * 1e-6 or DEFAULT_PERIOD_S
        unit = None if cloud.times is None else time_unit(cloud.times, stamps_us[0], period_s)
        return LidarTopic(
            topic=topic.name,
            intensity_max=scale,
            point_times=unit,  # type: ignore[arg-type]
            compensated=registered or cloud.times is None,
        )


def _attempt(read: Callable[..., T], *message: Any) -> T | None:
    """Return what a function reads of a message, or None if that is damaged; the conversion names it."""
    try:
        return read(*message)
    except Exception:  # foreign decoders raise errors of any class
        return None


def _fault(read: Callable[..., Any], *message: Any) -> str | None:
    """Return why a function cannot read a message, or None if it can."""
    try:
        read(*message)
    except InputError as error:
        return str(error)
    return None


def _placed(content: Any, fixed: bool = False) -> list[Placed]:
    return [dataclasses.replace(one, fixed=fixed) for one in read_placed(content)]


def _calibration_of(images: str, frame: list[str], frames: dict[str, list[str]]) -> str | None:
    """Return the topic of CameraInfo that belongs to a topic of images.

    That is the one in the nearest namespace around it. One in the root, or in another namespace, could belong
    to any camera, so it must name the same frame.
    """
    # The namespace of a topic is its path without the last part
    spaces = {info: info.rpartition("/")[0] for info in frames}
    around = [info for info, space in spaces.items() if space and images.startswith(f"{space}/")]
    if around:
        return max(around, key=lambda info: len(spaces[info]))
    return next((info for info, named in frames.items() if named and named == frame and named[0]), None)


def _camera_name(topic: str, used: set[str]) -> str:
    """Return a name for the camera of a topic: the last part that is no word for images."""
    parts = [part for part in topic.split("/") if part]
    kinds = ("image", "compressed", "raw", "color", "rect", "rgb")
    named = [part for part in parts if not any(part.startswith(kind) for kind in kinds)]
    name = _plain(named[-1] if named else parts[-1])
    return name if name not in used else _plain("_".join(parts))


def _plain(name: str) -> str:
    """Return a name of letters, digits, dots, dashes and underscores."""
    letters = "".join(letter if letter.isalnum() or letter in "._-" else "_" for letter in name)
    return letters.lstrip(".") or "bag"
