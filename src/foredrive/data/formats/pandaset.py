"""py123d's PandaSet parser, with a safe reader of its pickle files, and with the attributes of cuboids.

Raw PandaSet stores sweeps, cuboids and semantic labels as gzipped pickles of tables. py123d opens all of them
with one unrestricted unpickling function. Converting a log, or opening one that refers to raw sweeps, could
thus run any code in the files. This module replaces that function for all of py123d. It also replaces the
function by which sweeps find the pose of their frame, which takes the number of a file for a place in a list.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from py123d.datatypes import PinholeCameraMetadata, PinholeIntrinsics, Timestamp
from py123d.parser.base_dataset_parser import ModalitiesSync, ParsedCamera
from py123d.parser.pandaset import pandaset_parser, pandaset_sensor_io
from py123d.parser.pandaset.pandaset_parser import PandasetLogParser
from py123d.parser.pandaset.utils.pandaset_constants import (
    PANDASET_BOX_DETECTIONS_SE3_METADATA,
    PANDASET_CAMERA_DISTORTIONS,
    PANDASET_CAMERA_EXTRINSICS,
    PANDASET_CAMERA_MAPPING,
    PANDASET_EGO_STATE_SE3_METADATA,
    PANDASET_LIDAR_MERGED_METADATA,
)
from py123d.parser.pandaset.utils.pandaset_utils import extrinsic_to_imu, pandaset_pose_dict_to_pose_se3
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.modalities import attributes_modality
from foredrive.data.notices import note
from foredrive.data.safe_pickle import load_table
from foredrive.errors import InputError
from foredrive.scene import Attribute
from foredrive.scene.boxes import UNKNOWN

_FRONT = "front_camera"
_CAMERA_FILES = ("intrinsics.json", "poses.json", "timestamps.json")
_SIZE_WH = (1920, 1080)
_SWEEP_S = 0.1
"""A sweep's time is that of its end."""

pandaset_parser.read_pkl_gz = load_table
pandaset_sensor_io.read_pkl_gz = load_table

_ATTRIBUTE_OF_VALUE = {
    "attributes.rider_status": {
        "With Rider": Attribute.CYCLE_WITH_RIDER,
        "Without Rider": Attribute.CYCLE_WITHOUT_RIDER,
    },
    "attributes.pedestrian_behavior": {
        "Walking": Attribute.PEDESTRIAN_MOVING,
        "Standing": Attribute.PEDESTRIAN_STANDING,
        "Sitting": Attribute.PEDESTRIAN_SITTING_LYING_DOWN,
        "Lying": Attribute.PEDESTRIAN_SITTING_LYING_DOWN,
    },
    "attributes.object_motion": {
        "Moving": Attribute.VEHICLE_MOVING,
        "Stopped": Attribute.VEHICLE_STOPPED,
        "Parked": Attribute.VEHICLE_PARKED,
    },
}
"""nuScenes' attributes of the values in PandaSet's columns. Two-wheelers also have a motion, so the columns
are asked in this order."""


@dataclass(frozen=True)
class _Pose:
    position: dict[Literal["x", "y", "z"], FiniteFloat]
    heading: dict[Literal["w", "x", "y", "z"], FiniteFloat]


_SCHEMAS = {
    "timestamps.json": TypeAdapter(list[FiniteFloat]),
    "poses.json": TypeAdapter(list[_Pose]),
    "intrinsics.json": TypeAdapter(dict[Literal["fx", "fy", "cx", "cy"], FiniteFloat]),
}
"""Types of the JSON files of a log."""


class PandasetParser(PandasetLogParser):
    """py123d's parser of frames that may lack files, with an `Attribute` for each box.

    A file that is missing costs what is in it. The poses and times of a frame are the entries of its number.
    In a part of a log whose lists were cut to its frames, the first entries belong to the first frame.
    """

    def _iter_modalities_sync_from_path(self, source_log_path: Path) -> Iterator[ModalitiesSync]:
        # Check all JSON files before py123d reads them, as its errors do not name them
        for file in sorted([*source_log_path.glob("meta/*.json"), *source_log_path.glob("camera/*/*.json")]):
            if file.name in _SCHEMAS:
                _check_json(file, _SCHEMAS[file.name])
        cameras = _cameras(source_log_path)
        if _FRONT not in cameras:
            raise InputError(f"{source_log_path}: no poses of {_FRONT}, which are those of the vehicle")
        sweep_s = _by_number(source_log_path / "meta" / "timestamps.json")
        sweeps = set(_numbers(source_log_path / "lidar", ".pkl.gz"))
        # Every number between the first and the last is a frame or noted as missing
        numbers = frame_numbers(source_log_path)
        for number in range(min(numbers, default=0), max(numbers, default=-1) + 1):
            place = f"{number:02d}"
            if number not in numbers:
                note("frames", "missing", place)
                continue
            pose, time_s = (values.get(number) for values in (cameras[_FRONT].poses, cameras[_FRONT].times_s))
            if pose is None or time_s is None or number not in sweep_s:
                note("frames", "without a pose or a time, left out", place)
                continue
            # The log's time is that of the begin of the sweep
            now = Timestamp.from_s(sweep_s[number] - _SWEEP_S)
            modalities: list[Any] = [
                pandaset_parser._extract_pandaset_sensor_ego_state(
                    pose, PANDASET_EGO_STATE_SE3_METADATA, Timestamp.from_s(time_s)
                ),
                *_boxes(source_log_path, number, now),
            ]
            if number in sweeps:
                modalities.append(
                    pandaset_parser._extract_pandaset_lidar(
                        source_log_path, number, now, PANDASET_LIDAR_MERGED_METADATA
                    )
                )
            else:
                note("lidar", "missing sweeps", place)
            modalities += [
                image for camera in cameras.values() if (image := camera.image(number)) is not None
            ]
            yield ModalitiesSync(now, modalities)


@dataclass(frozen=True)
class _Camera:
    """A camera's folder: calibration, and poses and times by the numbers of frames."""

    folder: Path
    metadata: PinholeCameraMetadata
    poses: dict[int, dict[str, dict[str, float]]]
    times_s: dict[int, float]

    def image(self, number: int) -> ParsedCamera | None:
        """Return the image of a frame, or None with a notice."""
        file, root = self.folder / f"{number:02d}.jpg", self.folder.parents[2]
        if not file.is_file():
            note(self.folder.name, "missing images", file.stem)
            return None
        if number not in self.poses or number not in self.times_s:
            note(self.folder.name, "images without a pose or a time, left out", file.stem)
            return None
        return ParsedCamera(
            metadata=self.metadata,
            timestamp=Timestamp.from_s(self.times_s[number]),
            camera_to_global_se3=pandaset_pose_dict_to_pose_se3(self.poses[number]),
            dataset_root=root,
            relative_path=file.relative_to(root),
        )


def _cameras(log: Path) -> dict[str, _Camera]:
    """Return the cameras of a log by name. One that lacks a file of its own is left out with a notice."""
    cameras = {}
    for name, camera_id in PANDASET_CAMERA_MAPPING.items():
        folder = log / "camera" / name
        lacking = [file for file in _CAMERA_FILES if not (folder / file).is_file()]
        if lacking:
            note(name, f"left out; without {', '.join(lacking)}")
            continue
        intrinsics = json.loads((folder / "intrinsics.json").read_bytes())
        metadata = PinholeCameraMetadata(
            camera_name=name,
            camera_id=camera_id,
            width=_SIZE_WH[0],
            height=_SIZE_WH[1],
            intrinsics=PinholeIntrinsics(**intrinsics),
            distortion=PANDASET_CAMERA_DISTORTIONS[name],
            camera_to_imu_se3=extrinsic_to_imu(PANDASET_CAMERA_EXTRINSICS[name]),
            is_undistorted=True,
        )
        poses, times_s = (_by_number(folder / file) for file in ("poses.json", "timestamps.json"))
        cameras[name] = _Camera(folder, metadata, poses, times_s)
    return cameras


def _boxes(log: Path, number: int, now: Timestamp) -> list[Any]:
    """Return the boxes of a frame and their attributes; nothing, with a notice, without annotations."""
    cuboids = log / "annotations" / "cuboids" / f"{number:02d}.pkl.gz"
    if not cuboids.is_file():
        note("annotations/cuboids", "frames without boxes", f"{number:02d}")
        return []
    boxes = pandaset_parser._extract_pandaset_box_detections(
        log, number, now, PANDASET_BOX_DETECTIONS_SE3_METADATA
    )
    of_uuid = _attributes(cuboids)
    attributes = [of_uuid[box.attributes.track_token] for box in boxes.box_detections]
    return [boxes, attributes_modality(attributes, now)]


def frame_numbers(log: Path) -> set[int]:
    """Return the numbers of the frames of which there is a sweep or an image."""
    images = [_numbers(log / "camera" / name, ".jpg") for name in PANDASET_CAMERA_MAPPING]
    return set(_numbers(log / "lidar", ".pkl.gz")).union(*images)


def _numbers(folder: Path, suffix: str) -> list[int]:
    stems = [file.name.removesuffix(suffix) for file in folder.glob(f"[0-9]*{suffix}")]
    return sorted(int(stem) for stem in stems if stem.isdecimal())


def _by_number(file: Path) -> dict[int, Any]:
    """Return the entries of a list of a log by the numbers of their frames.

    Raises:
        InputError: the file is missing, or it is not clear which frames its entries belong to.
    """
    if not file.is_file():
        raise InputError(f"{file}: no such file")
    entries = json.loads(file.read_bytes())
    log = file.parents[1] if file.parent.name == "meta" else file.parents[2]
    numbers = frame_numbers(log)
    first, last = min(numbers, default=0), max(numbers, default=-1)
    # A whole list: entries are numbered from 0
    if last < len(entries):
        return dict(enumerate(entries))
    # A list that was cut to the frames of a part of the log
    if len(entries) == last - first + 1:
        return dict(enumerate(entries, start=first))
    raise InputError(
        f"{file}: {len(entries)} entries for the frames {first:02d} to {last:02d}; "
        "it is not clear which belongs to which"
    )


def _check_json(file: Path, schema: Any) -> None:
    """Check a file before py123d reads it. Its errors come later, without the file's name."""
    try:
        schema.validate_json(file.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{file}: {f'{where}: ' if where else ''}{first['msg']}") from error


def _attributes(cuboids: Path) -> dict[str, int]:
    """Return the attribute of each cuboid by its uuid."""
    table = load_table(cuboids)
    attributes = dict.fromkeys(table["uuid"].tolist(), UNKNOWN)
    # The first column that gives an attribute decides
    for column, attribute_of in _ATTRIBUTE_OF_VALUE.items():
        values = table[column].tolist() if column in table.columns else []
        for uuid, value in zip(table["uuid"].tolist(), values, strict=False):
            if attributes[uuid] == UNKNOWN and value in attribute_of:
                attributes[uuid] = attribute_of[value]
    return attributes


pandaset_sensor_io.read_json = _by_number  # it reads the poses of the front camera and nothing else


def find_pandaset(source: Path) -> Iterator[RawLog]:
    """Yield the raw logs of a folder: of its root, of one log, or of one or two levels above them."""
    for folder in folders_with(source, "annotations/cuboids"):
        yield RawLog(folder, PandasetParser(folder, folder.name, "pandaset_train"))
