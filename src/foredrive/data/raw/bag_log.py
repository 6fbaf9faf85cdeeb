"""Logs from bags: the frames are the sweeps, or the images of the first camera in a bag without lidar."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, overload

import numpy as np
from jaxtyping import Float64
from py123d.datatypes import LogMetadata

from foredrive.data.camera_streams import CameraSpec
from foredrive.data.log_paths import LogPath
from foredrive.data.own_logs import Points, write_log
from foredrive.data.raw.bag_files import Bag, open_bag
from foredrive.data.raw.bag_messages import (
    Calibration,
    Placed,
    frame_of,
    read_calibration,
    read_cloud,
    read_image,
    read_placed,
    stamp_us,
)
from foredrive.data.raw.bag_topics import BagTopics, read_topics, topics_file
from foredrive.data.raw.frame_tree import FrameTree
from foredrive.data.raw.raw_log import RawLog
from foredrive.errors import InputError

_LEVEL = np.eye(4)


def find_bags(source: Path, topics: Path | None = None) -> Iterator[RawLog]:
    """Yield a bag, or the bags of a folder that have their YAML beside them.

    Raises:
        InputError: the YAML of the bag is missing.
    """
    bags = [source] if source.is_file() or (source / "metadata.yaml").is_file() else []
    if not bags:
        files = sorted(source.glob("*.topics.yaml"))
        bags = [source / file.name.removesuffix(".topics.yaml") for file in files]
    for bag in bags:
        file = topics or topics_file(bag)
        if not file.is_file():
            raise InputError(f"{bag}: no {file}; write it by: foredrive convert rosbag {bag} --propose")
        yield RawLog(bag, BagLog(bag, read_topics(file)))


@dataclass
class _Found:
    """Times, transforms and calibrations that a first pass over a bag finds."""

    posed: list[Placed] = field(default_factory=list)
    """From the topic of poses, whose parents go before those of the transforms."""
    placed: list[Placed] = field(default_factory=list)
    stamps_us: dict[str, list[int]] = field(default_factory=dict)
    frames: dict[str, str] = field(default_factory=dict)
    calibrations: dict[str, Calibration] = field(default_factory=dict)


@dataclass(frozen=True)
class BagLog:
    """One bag with its topics, as a log that writes itself."""

    bag: Path
    topics: BagTopics

    def get_log_metadata(self) -> LogMetadata:
        """Return split and name of the log."""
        return LogMetadata("own", self.topics.split, self.topics.name, location=None)

    def write(self, out: Path, tick: Callable[[], None]) -> LogPath:
        """Read poses, times and calibrations first, then images and sweeps one at a time."""
        topics = self.topics
        with open_bag(self.bag) as bag:
            self._check_topics(bag)
            found = _first_pass(bag, topics)
            tree = FrameTree([*found.posed, *found.placed])
            times_us = self._frame_times(found, tree)
            T_ego_origin = _LEVEL.copy()
            T_ego_origin[:3, 3] = topics.ego_origin_m
            pose = tree.pose(topics.world_frame, topics.ego_frame, times_us.astype(np.float64)) @ T_ego_origin

            def mounted(frame: str) -> Float64[np.ndarray, "4 4"]:
                T = tree.between(topics.ego_frame, frame, int(times_us[0]))
                return np.asarray(np.linalg.inv(T_ego_origin) @ T)

            images, image_t_s, cameras = {}, {}, []
            for name, camera in topics.cameras.items():
                calibration = found.calibrations[camera.info]
                T_ego_cam = mounted(camera.frame or found.frames[camera.images])
                spec = CameraSpec(name, calibration.K, T_ego_cam, calibration.size_hw, dist=calibration.dist)
                cameras.append(spec)
                stream = _Stream(bag, camera.images, found.stamps_us[camera.images], times_us, read_image)
                images[name], image_t_s[name] = stream, stream.t_us * 1e-6
            sweeps, position = None, np.array([0.0, 0.0, 1.8])
            if topics.lidar is not None:
                T_ego_lidar = mounted(topics.lidar.frame or found.frames[topics.lidar.topic])
                position, stamps = T_ego_lidar[:3, 3], found.stamps_us[topics.lidar.topic]
                sweeps = _Stream(bag, topics.lidar.topic, stamps, times_us, self._points(T_ego_lidar), tick)
            return write_log(
                out,
                topics.name,
                times_us * 1e-6,
                pose,
                cameras=cameras,
                images=images,
                image_t_s=image_t_s,
                sweeps=sweeps,
                lidar_position_m=tuple(position.tolist()),
                path=self._path(tree, times_us, T_ego_origin),
                split=topics.split,
            )

    def _path(
        self, tree: FrameTree, times_us: np.ndarray, T_ego_origin: Float64[np.ndarray, "4 4"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return times and poses of the vehicle at the rate of the bag."""
        topics = self.topics
        at_us = np.union1d(tree.times_us(topics.world_frame, topics.ego_frame), times_us)
        poses = tree.pose(topics.world_frame, topics.ego_frame, at_us.astype(np.float64))
        return at_us * 1e-6, poses @ T_ego_origin

    def _points(self, T_ego_lidar: Float64[np.ndarray, "4 4"]) -> Callable[[Any], Points]:
        assert self.topics.lidar is not None
        scale, compensated = self.topics.lidar.intensity_max, self.topics.lidar.compensated

        def read(message: Any) -> Points:
            cloud = read_cloud(message)
            xyz = cloud.xyz_m @ T_ego_lidar[:3, :3].T + T_ego_lidar[:3, 3]
            intensity = None if cloud.intensity is None else np.nan_to_num(cloud.intensity / scale).clip(0, 1)
            fits = cloud.channel is not None and ((cloud.channel >= 0) & (cloud.channel <= 255)).all()
            return Points(xyz, intensity, cloud.dt_s, cloud.channel if fits else None, compensated)

        return read

    def _check_topics(self, bag: Bag) -> None:
        named = [one for camera in self.topics.cameras.values() for one in (camera.images, camera.info)]
        named += [self.topics.lidar.topic] if self.topics.lidar else []
        for topic in [*named, *([self.topics.pose] if self.topics.pose else [])]:
            if topic not in bag.topics or not bag.topics[topic].count:
                have = ", ".join(sorted(bag.topics))
                raise InputError(f"{self.bag}: no messages of the topic {topic}; there are: {have}")
        if not named:
            raise InputError(f"{self.bag}: its topics name neither cameras nor a lidar")

    def _frame_times(self, found: _Found, tree: FrameTree) -> np.ndarray:
        """Return the times of the frames, as far as there are poses."""
        topics = self.topics
        first = topics.lidar.topic if topics.lidar else next(iter(topics.cameras.values())).images
        stamps = np.unique(np.array(found.stamps_us[first], np.int64))
        for frame in (topics.world_frame, topics.ego_frame):
            if frame not in tree.frames:
                known = ", ".join(sorted(tree.frames)) or "none"
                raise InputError(f"{self.bag}: no transform has the frame {frame!r}; there are: {known}")
        low, high = tree.span_us(topics.world_frame, topics.ego_frame)
        kept = stamps[(stamps >= low) & (stamps <= high)]
        if not len(kept):
            raise InputError(
                f"{self.bag}: no message of {first} lies in the time of the poses: other clocks?"
            )
        return kept


def _first_pass(bag: Bag, topics: BagTopics) -> _Found:
    found = _Found()
    infos = {camera.info for camera in topics.cameras.values()}
    sensed = {camera.images for camera in topics.cameras.values()}
    sensed |= {topics.lidar.topic} if topics.lidar else set()
    tf = {one.name for one in bag.topics.values() if one.kind == "tf"}
    wanted = infos | sensed | tf | ({topics.pose} if topics.pose else set())
    for topic, message in bag.read(wanted):
        if topic in infos:
            if topic not in found.calibrations:
                found.calibrations[topic] = read_calibration(message)
        elif topic in sensed:
            found.stamps_us.setdefault(topic, []).append(stamp_us(message))
            found.frames.setdefault(topic, frame_of(message))
        elif topic == topics.pose:
            for one in read_placed(message):
                T = one.T_parent_child
                found.posed.append(Placed(one.parent, one.child or topics.ego_frame, one.t_us, T))
        else:
            found.placed += read_placed(message)
    return found


class _Stream(Sequence[Any]):
    """The messages of a topic nearest to each frame, read when they are asked for, best in their order.

    Frames without a message within half of the frames' usual period have None.
    """

    def __init__(
        self,
        bag: Bag,
        topic: str,
        stamps_us: list[int],
        times_us: np.ndarray,
        decode: Callable[[Any], Any],
        tick: Callable[[], None] = lambda: None,
    ) -> None:
        stamps = np.array(stamps_us, np.int64)
        if (np.diff(stamps) < 0).any():
            raise InputError(f"the stamps of {topic} run backwards at message {np.diff(stamps).argmin() + 1}")
        after = np.searchsorted(stamps, times_us).clip(1, max(len(stamps) - 1, 1))
        before = after - 1
        after = after.clip(0, len(stamps) - 1)
        self._at = np.where(times_us - stamps[before] <= stamps[after] - times_us, before, after)
        period_us = float(np.median(np.diff(times_us))) if len(times_us) > 1 else 1e5
        self._there = np.abs(stamps[self._at] - times_us) <= 0.5 * period_us
        self.t_us = np.where(self._there, stamps[self._at], times_us)
        self._bag, self._topic, self._decode, self._tick = bag, topic, decode, tick
        self._rewind()

    def _rewind(self) -> None:
        self._messages = enumerate(message for _, message in self._bag.read([self._topic]))
        self._current: tuple[int, Any] = (-1, None)

    def __len__(self) -> int:
        return len(self._at)

    @overload
    def __getitem__(self, frame: int) -> Any: ...
    @overload
    def __getitem__(self, frame: slice) -> Sequence[Any]: ...
    def __getitem__(self, frame: int | slice) -> Any:
        assert isinstance(frame, int)
        self._tick()
        if not self._there[frame]:
            return None
        if self._current[0] > self._at[frame]:
            self._rewind()
        while self._current[0] < self._at[frame]:
            self._current = next(self._messages)
        try:
            return self._decode(self._current[1])
        except InputError as error:
            raise InputError(f"{self._topic}, message {self._current[0]}: {error}") from error
