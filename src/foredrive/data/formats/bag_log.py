"""Logs from bags: the frames are the sweeps, or the images of the first camera in a bag without lidar."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64, UInt8
from py123d.datatypes import LogMetadata

from foredrive.data.camera_streams import CameraSpec
from foredrive.data.ego_path import MAX_GAP_S
from foredrive.data.formats.bag_contents import Bag, Message
from foredrive.data.formats.bag_files import is_bag, open_bag
from foredrive.data.formats.bag_images import read_image, read_pixels
from foredrive.data.formats.bag_index import BagIndex, Stamp, index_bag, transforms
from foredrive.data.formats.bag_messages import (
    Calibration,
    read_calibration,
    read_cloud,
    seconds_since_stamp,
    stamp_us,
    time_unit,
)
from foredrive.data.formats.bag_mounts import USUAL_POSITION_M, Mounts
from foredrive.data.formats.bag_topics import (
    BagTopics,
    CameraTopics,
    LidarTopic,
    is_rectified_camera,
    read_topics,
    topics_file,
)
from foredrive.data.formats.frame_tree import FrameTree
from foredrive.data.formats.guard import DEFAULT_PERIOD_S, PartSequence, nearest_parts
from foredrive.data.formats.raw_log import RawLog
from foredrive.data.images import check_size
from foredrive.data.log_paths import LogPath
from foredrive.data.notices import note
from foredrive.data.own_logs import Points, write_log
from foredrive.errors import InputError

_NEAR_M = 1e-3


def find_bags(source: Path, topics: Path | None = None) -> Iterator[RawLog]:
    """Yield a bag, or the bags of a folder that have their YAML beside them.

    Raises:
        InputError: the YAML of the bag is missing.
    """
    bags = [source] if is_bag(source) else []
    if not bags:
        # A folder without metadata may hold several bags, each with its YAML beside it
        files = sorted(source.glob("*.topics.yaml"))
        bags = [source / file.name.removesuffix(".topics.yaml") for file in files]
    for bag in bags:
        file = topics or topics_file(bag)
        if not file.is_file():
            raise InputError(f"{bag}: no {file}; write it by: foredrive convert rosbag {bag} --propose")
        yield RawLog(bag, BagLog(bag, read_topics(file)))


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
            index = index_bag(bag, topics)
            # One tree of transforms gives the path of the vehicle and all mounts
            tree = FrameTree(transforms(index, topics))
            times_us = self._frame_times(index, tree)
            # The log's ego frame is on the ground below the rear axle, which may be off the bag's frame
            T_ego_origin = np.eye(4)
            T_ego_origin[:3, 3] = topics.ego_origin_m
            poses = (
                tree.pose(topics.world_frame, topics.ego_frame, times_us.astype(np.float64)) @ T_ego_origin
            )

            mounts = Mounts(tree, topics.ego_frame, T_ego_origin)
            # Each camera is a stream of images, read one at a time
            images, cameras, image_mounts = {}, [], {}
            for name, camera in topics.cameras.items():
                stream, spec, T_ego_cam = _stream_of_camera(name, camera, bag, index, times_us, mounts)
                images[name] = stream
                cameras.append(spec)
                if not np.allclose(T_ego_cam, T_ego_cam[:1], atol=1e-6):
                    text = "its camera moves on the vehicle; each image has the mount of its time"
                    note(camera.images, text)
                    image_mounts[name] = T_ego_cam
            # Without a lidar its position is unimportant: a usual place on a roof
            sweeps, position_m = None, USUAL_POSITION_M
            if topics.lidar is not None:
                lidar, first = topics.lidar, index.first[topics.lidar.topic]
                position_m = mounts.position_m(lidar, first, int(times_us[0]))
                clouds = _Clouds(lidar, mounts, self._time_unit(index))
                sweeps = _Stream(bag, lidar.topic, index.stamps[lidar.topic], times_us, clouds)
            # A sensor without a single readable message is an error
            for stream in [*images.values(), *([] if sweeps is None else [sweeps])]:
                stream.check()
            return write_log(
                out,
                topics.name,
                times_us * 1e-6,
                poses,
                cameras=cameras,
                images=images,
                image_t_s={name: stream.t_us * 1e-6 for name, stream in images.items()},
                sweeps=sweeps,
                image_mounts=image_mounts,
                lidar_position_m=position_m,
                path=self._path(tree, times_us, T_ego_origin),
                split=topics.split,
                tick=tick,
            )

    def _path(
        self, tree: FrameTree, times_us: np.ndarray, T_ego_origin: Float64[np.ndarray, "4 4"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return times and poses of the vehicle at the rate of the bag."""
        topics = self.topics
        # The path has all poses of the bag between the frames, not only those at the frames
        at_us = np.union1d(tree.times_us(topics.world_frame, topics.ego_frame), times_us)
        poses = tree.pose(topics.world_frame, topics.ego_frame, at_us.astype(np.float64))
        return at_us * 1e-6, poses @ T_ego_origin

    def _time_unit(self, index: BagIndex) -> str | None:
        """Return the unit of the times of points, or None if they have none or these are not used.

        Raises:
            InputError: the times fit no unit.
        """
        assert self.topics.lidar is not None
        lidar = self.topics.lidar
        first = index.first[lidar.topic]
        times = read_cloud(first).times
        # A given unit takes precedence over the guess
        if lidar.point_times is not None or times is None:
            return None if lidar.point_times == "none" else lidar.point_times
        stamps_us = np.unique(index.stamps_us(lidar.topic))
        # Period between sweeps; a single sweep has the usual one
        period_s = float(np.median(np.diff(stamps_us))) * 1e-6 if len(stamps_us) > 1 else DEFAULT_PERIOD_S
        unit = time_unit(times, stamp_us(first), period_s)
        if unit is None:
            span = f"{times.min():g} to {times.max():g}"
            raise InputError(
                f"{self.bag}: the times of points in {lidar.topic} ({span}) fit no unit; "
                "write `point_times: s`, ms, us, ns or none to its entry in the YAML"
            )
        note(lidar.topic, f"times of points were read as {unit}")
        return unit

    def _check_topics(self, bag: Bag) -> None:
        cameras = self.topics.cameras.values()
        named = [topic for camera in cameras for topic in (camera.images, camera.info) if topic is not None]
        named += [self.topics.lidar.topic] if self.topics.lidar else []
        for topic in [*named, *([self.topics.pose] if self.topics.pose else [])]:
            if topic not in bag.topics or not bag.topics[topic].count:
                have = ", ".join(sorted(bag.topics))
                raise InputError(f"{self.bag}: no messages of the topic {topic}; there are: {have}")
        if not named:
            raise InputError(f"{self.bag}: its topics name neither cameras nor a lidar")

    def _frame_times(self, index: BagIndex, tree: FrameTree) -> np.ndarray:
        """Return the times of the frames, as far as there are poses."""
        topics = self.topics
        first = topics.lidar.topic if topics.lidar else next(iter(topics.cameras.values())).images
        # Frames are at the stamps of the lidar, or of the first camera, within the span of the poses
        stamps = np.unique(index.stamps_us(first))
        for frame in (topics.world_frame, topics.ego_frame):
            if frame not in tree.frames:
                names = ", ".join(sorted(tree.frames)) or "none"
                raise InputError(f"{self.bag}: no transform has the frame {frame!r}; there are: {names}")
        low, high = tree.span_us(topics.world_frame, topics.ego_frame)
        outside = {
            "frames before the first pose, left out": stamps < low,
            "frames after the last pose, left out": stamps > high,
            f"frames between poses more than {MAX_GAP_S:g} s apart, left out": tree.holes(
                topics.world_frame, topics.ego_frame, stamps
            ),
        }
        for text, out in outside.items():
            for t_us in stamps[out].tolist():
                note(first, text, f"{t_us * 1e-6:.3f} s")
        kept = stamps[~np.any(list(outside.values()), axis=0)]
        if not len(kept):
            times = (f"{t_us * 1e-6:.3f}" for t_us in (stamps[0], stamps[-1], low, high))
            message = "{}: no message of {} ({} to {} s) lies between poses ({} to {} s) at most {:g} s apart"
            raise InputError(message.format(self.bag, first, *times, MAX_GAP_S))
        return kept


def _stream_of_camera(
    name: str, camera: CameraTopics, bag: Bag, index: BagIndex, times_us: np.ndarray, mounts: Mounts
) -> tuple["_Stream", CameraSpec, Float64[np.ndarray, "N 4 4"]]:
    """Return the images of a camera, its description, and its mount T_ego_cam at the time of each image."""
    calibration = _calibration(camera, index)
    read = _Images(calibration.size_hw, camera.value_range)
    stream = _Stream(bag, camera.images, index.stamps[camera.images], times_us, read)
    T_ego_cam = mounts.of_camera(camera, index.first[camera.images], stream.t_us)
    # Rectified images are turned against the optical axes
    T_ego_cam[:, :3, :3] = T_ego_cam[:, :3, :3] @ calibration.R_optical_cam
    if camera.value_range is not None:
        low, high = camera.value_range
        note(camera.images, f"images of 16 bits; {low:g} became 0 and {high:g} became 255")
    spec = CameraSpec(name, calibration.K, T_ego_cam[0], calibration.size_hw, dist=calibration.dist)
    return stream, spec, T_ego_cam


def _calibration(camera: CameraTopics, index: BagIndex) -> Calibration:
    """Return the calibration of a camera: that of its topic, or the given one at the size of its images."""
    if camera.intrinsics is None:
        assert camera.info is not None
        rectified = is_rectified_camera(camera)
        calibration = read_calibration(index.first[camera.info], rectified)
        if rectified:
            note(camera.images, f"rectified images; P and R of {camera.info} hold, without distortion")
        if abs(calibration.offset_m) > _NEAR_M:
            text = (
                f"P of {camera.info} is that of a camera {abs(calibration.offset_m):.3f} m beside another one"
            )
            note(camera.images, f"{text}; the camera is where its own frame is")
        return calibration
    # ROS has pixel centres at whole numbers, the log at +0.5
    lens = camera.intrinsics
    K = np.array([[lens.fx, 0, lens.cx + 0.5], [0, lens.fy, lens.cy + 0.5], [0, 0, 1]])
    dist = np.zeros(5)
    dist[: len(lens.distortion)] = lens.distortion
    # Intrinsics hold for the size of the images
    height, width = read_pixels(index.first[camera.images]).shape[:2]
    return Calibration(K, dist, (height, width))


@dataclass(frozen=True)
class _Clouds:
    """Reads the clouds of a lidar."""

    lidar: LidarTopic
    mounts: Mounts
    unit: str | None
    """The unit of the points' times; None: the times are not used."""

    def decoded(self, message: Any, t_us: int) -> Points:
        """Return the points of a message, stamped `t_us`, in the log's ego frame at their own times."""
        cloud, lidar = read_cloud(message), self.lidar
        T_ego_lidar = self.mounts.of_cloud(lidar, message, t_us)
        intensity = None if cloud.intensity is None else np.nan_to_num(cloud.intensity / lidar.intensity_max)
        if intensity is not None and (intensity > 1).any():
            largest = f"up to {intensity.max() * lidar.intensity_max:g}"
            note(lidar.topic, f"sweeps with intensities above {lidar.intensity_max:g}, clipped", largest)
        dt_s = None
        if self.unit is not None and cloud.times is not None:
            dt_s = seconds_since_stamp(cloud.times, stamp_us(message), self.unit)
        # Channels are stored in 8 bits
        fits = cloud.channel is not None and ((cloud.channel >= 0) & (cloud.channel <= 255)).all()
        return Points(
            cloud.xyz_m @ T_ego_lidar[:3, :3].T + T_ego_lidar[:3, 3],
            None if intensity is None else intensity.clip(0, 1),
            dt_s,
            cloud.channel if fits else None,
            # What registered points in the world has removed the motion within the sweep
            lidar.compensated or self.mounts.is_registered(lidar, message),
        )


@dataclass(frozen=True)
class _Images:
    """Reads the images of a camera."""

    size_hw: tuple[int, int]
    value_range: tuple[float, float] | None

    def decoded(self, message: Any, _: int) -> UInt8[np.ndarray, "H W 3"]:
        """Return the image of a message."""
        return check_size(read_image(message, self.value_range), self.size_hw)


class _Stream(PartSequence):
    """The messages of a topic nearest to each frame, read when they are asked for, best in their order.

    Frames without a readable message within half of the frames' usual period have None.
    """

    def __init__(
        self,
        bag: Bag,
        topic: str,
        stamps: list[Stamp],
        times_us: np.ndarray,
        reading: _Clouds | _Images,
    ) -> None:
        super().__init__(topic, "messages", len(times_us))
        numbers, stamps_us, _ = np.array(stamps, np.int64).reshape(-1, 3).T
        # Messages may come out of order: note them and sort by stamp
        for row in np.flatnonzero(np.diff(stamps_us) < 0) + 1:
            place = f"message {numbers[row]}, {stamps_us[row] * 1e-6:.3f} s"
            note(topic, "messages out of order, sorted by their stamps", place)
        order = np.argsort(stamps_us, kind="stable")
        numbers, stamps_us = numbers[order], stamps_us[order]
        # A message more than half a period away belongs to another frame
        nearest, self._exists = nearest_parts(stamps_us, times_us)
        self.t_us = np.where(self._exists, stamps_us[nearest], times_us)
        self._numbers = numbers[nearest]
        frames = np.flatnonzero(self._exists)
        # The last frame that needs each message, after which it can be dropped
        self._last_frame = dict(zip(self._numbers[frames].tolist(), frames.tolist(), strict=True))
        self._bag, self._topic, self._reading = bag, topic, reading
        self._note_missing(times_us, stamps_us)
        self._rewind()

    def _note_missing(self, times_us: Int64[np.ndarray, "T"], stamps_us: Int64[np.ndarray, "N"]) -> None:
        """Say which frames have no message beside them."""
        missing = times_us[~self._exists].tolist()
        if len(missing) < len(times_us):
            for t_us in missing:
                note(self._topic, "frames without a message beside them", f"{t_us * 1e-6:.3f} s")
            return
        spans = (f"{t_us * 1e-6:.3f}" for t_us in (stamps_us[0], stamps_us[-1], times_us[0], times_us[-1]))
        message = (
            "none of its {} messages ({} to {} s) is beside a frame ({} to {} s): the log has none of them"
        )
        note(self._topic, message.format(len(stamps_us), *spans))

    def _rewind(self) -> None:
        self._messages = enumerate(self._bag.read([self._topic]))
        self._position = -1
        self._ahead: dict[int, Message] = {}

    def _message(self, number: int) -> Message:
        """Return a message by its number. Those passed on the way are kept if a later frame needs them."""
        # A message that was passed and not kept: read the bag from its start again
        if number <= self._position and number not in self._ahead:
            self._rewind()
        while self._position < number:
            self._position, message = next(self._messages)
            if self._position in self._last_frame:
                self._ahead[self._position] = message
        return self._ahead[number]

    def _part(self, frame: int) -> Any:
        if not self._exists[frame]:
            return None
        number = int(self._numbers[frame])
        message = self._message(number)
        # Free a message after the last frame that needs it
        if self._last_frame[number] == frame:
            del self._ahead[number]
        place = f"message {number}, {self.t_us[frame] * 1e-6:.3f} s"
        t_us = int(self.t_us[frame])
        return self._read(place, lambda: self._reading.decoded(message.decode(), t_us))

    def check(self) -> None:
        """Check that one of the messages can be read, and begin anew."""
        super().check()
        self._rewind()
