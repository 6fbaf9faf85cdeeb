"""Reading of raw files: errors of one line, paths that stay in their folder, damaged parts left out."""

import contextlib
import os
import re
import sys
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
from jaxtyping import Bool, Int64
from py123d.common.io.lidar.path_lidar_io import load_point_cloud_data_from_path
from py123d.datatypes import BoxDetectionsSE3, Camera, EgoStateSE3, Lidar, LogMetadata, MapMetadata
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.datatypes.sensors.lidar import LidarMergedMetadata
from py123d.parser.base_dataset_parser import ParsedCamera, ParsedLidar, ParsedRadar

from foredrive.data.arrow_files import REFUSES_WRITING
from foredrive.data.formats.point_files import NUSCENES, read_points
from foredrive.data.images import read_rgb, whole_jpeg
from foredrive.data.notices import note
from foredrive.errors import InputError

T = TypeVar("T")

_NAME = re.compile(r"[\w-][\w.+-]*")
DEFAULT_PERIOD_S = 0.1
"""Time between the frames of a log that has only one."""
_READ_MODES = ("r", "rb", "rt", None)
_MISTAKES = (TypeError, AttributeError, NameError, ImportError)
"""Errors of code. Decoders of images, messages, sweeps and pickles raise none of them for damaged bytes."""


class _LastOpened:
    """The file that Python opened last below a folder. Many parsers' errors do not name it."""

    below: str | None = None
    file: str | None = None
    listens = False


@contextlib.contextmanager
def reading_raw(source: Path) -> Iterator[None]:
    """Convert every error of a parser into a one-line `InputError` that names the log and the last read file.

    Damaged files make foreign parsers raise errors of any class. Errors while writing to a full or read-only
    disk and interruptions are raised unchanged.
    """
    with _noting_opened(source):
        try:
            yield
        except InputError as error:
            # An error that names the log already stays as it is
            if source.name in str(error):
                raise
            raise InputError(f"{source}: {error}") from error
        except Exception as error:
            # Errors of writing are the user's disk, not damaged input
            if isinstance(error, OSError) and error.errno in REFUSES_WRITING:
                raise
            raise InputError(f"{source}: cannot read the raw log: {_reason(error)}{_place(error)}") from error


class PartReader:
    """Reads parts of one kind. Damaged ones are left out with a notice, unless all are damaged.

    Decoders raise errors of many classes. Only those that a mistake in code raises are not taken for damage.

    Args:
        subject: what the parts belong to: a topic, camera or folder.
        parts: their plural noun, such as "messages".
    """

    def __init__(self, subject: str, parts: str) -> None:
        self._subject, self._parts = subject, parts
        self._first: str | None = None
        self._faults: set[str] = set()
        self._whole = 0

    def __call__(self, place: str, read: Callable[[], T]) -> T | None:
        """Return one part, or None and a notice if it cannot be read.

        Args:
            place: names the part: its number, file and time.
            read: reads it.
        """
        # Errors of code are raised; all others are damage of this part
        try:
            part = read()
        except _MISTAKES:
            raise
        except Exception as error:  # libraries have errors of their own, such as rosbags' SerdeError
            if isinstance(error, OSError) and error.errno in REFUSES_WRITING:
                raise
            fault = f"{place}: {_reason(error)}"
            self._first = self._first or fault
            if fault not in self._faults:  # a part may be asked for again
                self._faults.add(fault)
                note(self._subject, f"unreadable {self._parts}, left out", fault)
            return None
        self._whole += 1
        return part

    def check(self) -> None:
        """Check that not all parts were damaged.

        Raises:
            InputError: none could be read.
        """
        if self._first is not None and not self._whole:
            raise InputError(f"{self._subject}: none of its {self._parts} can be read; {self._first}")


class PartSequence(Sequence[Any]):
    """The parts of a sensor, one a frame, read when they are asked for; None where none can be read."""

    def __init__(self, subject: str, parts: str, frames: int) -> None:
        self._read, self._frames = PartReader(subject, parts), frames

    def __len__(self) -> int:
        return self._frames

    @overload
    def __getitem__(self, frame: int) -> Any: ...
    @overload
    def __getitem__(self, frame: slice) -> Sequence[Any]: ...
    def __getitem__(self, frame: int | slice) -> Any:
        assert isinstance(frame, int)
        return self._part(frame)

    @abstractmethod
    def _part(self, frame: int) -> Any:
        """Return the part of a frame, read by `self._read`, or None."""

    def check(self) -> None:
        """Check that one of the parts can be read.

        Raises:
            InputError: none can.
        """
        # The first readable part is enough
        _ = any(self[frame] is not None for frame in range(len(self)))
        self._read.check()


def nearest_parts(
    part_us: Int64[np.ndarray, "P"], frame_us: Int64[np.ndarray, "T"]
) -> tuple[Int64[np.ndarray, "T"], Bool[np.ndarray, "T"]]:
    """Return which part is nearest to each frame, and whether it belongs to it.

    A part belongs to a frame that is at most half of the frames' usual period away.

    Args:
        part_us: times of at least one part, in order.
        frame_us: times of the frames, in order.
    """
    # Parts before and after each frame, and the nearer one of the two
    after = np.searchsorted(part_us, frame_us).clip(1, max(len(part_us) - 1, 1))
    before = after - 1
    after = after.clip(0, len(part_us) - 1)
    nearest = np.where(frame_us - part_us[before] <= part_us[after] - frame_us, before, after)
    period_us = float(np.median(np.diff(frame_us))) if len(frame_us) > 1 else 1e6 * DEFAULT_PERIOD_S
    return nearest, np.abs(part_us[nearest] - frame_us) <= 0.5 * period_us


class SensorFiles:
    """Loads the sensor files of a log's frames. A frame loses an image or a sweep that cannot be read."""

    def __init__(self, source: Path, dataset: str) -> None:
        self._source, self._dataset = source, dataset
        self._readers: dict[str, PartReader] = {}

    def load(self, modality: BaseModality) -> BaseModality | None:
        """Return a modality with its sensor data, or None if these cannot be read."""
        if isinstance(modality, ParsedCamera):
            return self._read(modality.metadata.camera_name, "images", modality, _whole_image)
        if isinstance(modality, ParsedLidar):
            return self._read("lidar", "sweeps", modality, self._sweep)
        return modality

    def check(self) -> None:
        """Check that each sensor has readable data at one time at least."""
        for reader in self._readers.values():
            reader.check()

    def _read(self, name: str, parts: str, modality: T, load: Callable[[T], BaseModality]) -> Any:
        reader = self._readers.setdefault(name, PartReader(f"{self._source.name}, {name}", parts))
        place = str(getattr(modality, "_relative_path", None) or modality.timestamp.time_us)  # type: ignore[attr-defined]
        return reader(place, lambda: load(modality))

    def _sweep(self, parsed: ParsedLidar) -> Lidar:
        """Load a sweep as py123d's writer would."""
        root, relative = parsed._dataset_root, parsed._relative_path
        metadata = parsed.metadata
        lidars = dict(metadata) if isinstance(metadata, LidarMergedMetadata) else None
        if str(relative).endswith(".pcd.bin"):
            read_points(Path(root) / relative, NUSCENES)  # its loader takes any number of columns for five
        points, features = load_point_cloud_data_from_path(
            relative,
            self._dataset,
            parsed._iteration,
            root,
            lidar_metadatas=lidars,
            load_kwargs=parsed.load_kwargs,
        )
        return Lidar(parsed.start_timestamp, parsed.end_timestamp, metadata, points, features)


def _whole_image(parsed: ParsedCamera) -> BaseModality:
    """Return a camera whose JPEG is whole, or with its decoded image.

    JPEGs go into the log as they are.
    """
    if not parsed.has_file_path or parsed.exposure_factor is not None:
        return parsed
    file = Path(parsed._dataset_root) / parsed._relative_path
    if not parsed.has_jpeg_file_path:
        return Camera(parsed.metadata, read_rgb(file), parsed.camera_to_global_se3, parsed.timestamp)
    whole_jpeg(file)
    return parsed


@contextlib.contextmanager
def _noting_opened(source: Path) -> Iterator[None]:
    """Note which file below the folder was opened last; audit events of Python tell of each."""
    if not _LastOpened.listens:
        sys.addaudithook(_note)  # it stays, and does nothing outside of such a block
        _LastOpened.listens = True
    before = _LastOpened.below
    _LastOpened.below, _LastOpened.file = os.path.abspath(source), None
    try:
        yield
    finally:
        _LastOpened.below = before


def _note(event: str, details: tuple[Any, ...]) -> None:
    # Only files opened for reading below the folder
    if event == "open" and _LastOpened.below is not None and isinstance(details[0], str | os.PathLike):
        path = os.path.abspath(details[0])
        if details[1] in _READ_MODES and path.startswith(_LastOpened.below):
            _LastOpened.file = path


def _place(error: Exception) -> str:
    """Return in which file the error arose, if the error does not say it."""
    opened = _LastOpened.file
    if opened is None or opened == _LastOpened.below or Path(opened).name in str(error):
        return ""
    return f" (in {os.path.relpath(opened, _LastOpened.below)})"


def _reason(error: Exception) -> str:
    said = next(iter(str(error).strip().splitlines()), "")
    if isinstance(error, KeyError):
        return f"{said} is unknown or missing"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, MemoryError):
        return "it asks for more memory than there is"
    if isinstance(error, FileNotFoundError) and error.filename:
        return f"{error.filename}: no such file"
    if isinstance(error, ValueError | AssertionError | OSError) and said:
        return said
    return f"{type(error).__name__}: {said}" if said else type(error).__name__


def check_names(metadata: LogMetadata | MapMetadata) -> None:
    """Check that the names by which a log or a map is stored cannot lead out of its folder.

    Raises:
        InputError: a name has other characters than letters, digits, dots, dashes, plus and underscores.
    """
    for what in ("split", "log_name", "location", "dataset"):
        name = getattr(metadata, what)
        # Names become folders: letters, digits and few signs, no path
        if name is not None and what != "location" and not _NAME.fullmatch(str(name)):
            raise InputError(f"the name {name!r} ({what}) cannot be that of a folder")
        if name is not None and what == "location" and re.search(r"[/\\\0]|^\.", str(name)):
            raise InputError(f"the name {name!r} ({what}) cannot be that of a file")


def check_inside(modality: BaseModality, source: Path) -> None:
    """Check that a sensor's file lies in the data set. Symbolic links of the user may lead elsewhere.

    Raises:
        InputError: the data set names a file outside of it.
    """
    if not isinstance(modality, ParsedCamera | ParsedLidar | ParsedRadar):
        return
    root, relative = modality._dataset_root, modality._relative_path
    if root is None or relative is None:
        return
    # Links are not resolved: a link of the user inside of the data set may lead elsewhere
    whole = os.path.abspath(os.path.join(root, relative))
    if os.path.commonpath([whole, os.path.abspath(root)]) != os.path.abspath(root):
        raise InputError(f"{source}: it names the file {str(relative)!r}, which is outside of the data set")


def check_finite(modality: BaseModality, source: Path) -> None:
    """Check that poses, calibrations and boxes are finite numbers. JSON and tables can hold others.

    Raises:
        InputError: one is not finite.
    """
    if isinstance(modality, EgoStateSE3):
        values, what = [modality.imu_se3.array], "a pose of the vehicle"
    elif isinstance(modality, BoxDetectionsSE3):
        values, what = [box.bounding_box_se3.array for box in modality.box_detections], "a box"
    elif isinstance(modality, ParsedCamera | Camera):
        pose, lens = modality.camera_to_global_se3, getattr(modality.metadata, "intrinsics", None)
        values = [part.array for part in (pose, lens) if part is not None]
        what = f"the pose or the calibration of {modality.metadata.camera_name}"
    else:
        return
    if not all(np.isfinite(part).all() for part in values):
        raise InputError(f"{source}: {what} at {modality.timestamp.time_us} µs is not finite")
