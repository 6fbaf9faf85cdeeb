"""A 123D parser of data sets in nuScenes' format with other scenes than nuScenes' own, without the devkit.

py123d's parser knows the published scenes alone, needs all six cameras, and nuscenes-devkit. This one reads
any folder v1.0-NAME, such as those of `foredrive export nuscenes`, with the cameras that are there.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from py123d.datatypes import (
    BoxDetectionAttributes,
    BoxDetectionSE3,
    BoxDetectionsSE3,
    CameraID,
    EgoStateSE3,
    LidarID,
    LidarMergedMetadata,
    LidarMetadata,
    LogMetadata,
    PinholeCameraMetadata,
    PinholeIntrinsics,
    Timestamp,
)
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.geometry import BoundingBoxSE3, PoseSE3
from py123d.parser.base_dataset_parser import BaseLogParser, ModalitiesSync, ParsedCamera, ParsedLidar
from py123d.parser.nuscenes.utils.nuscenes_constants import (
    NUSCENES_BOX_DETECTIONS_SE3_METADATA,
    NUSCENES_DETECTION_NAME_DICT,
    NUSCENES_EGO_STATE_SE3_METADATA,
    NUSCENES_LIDAR_SWEEP_DURATION_US,
)

from foredrive.data.camera_streams import CameraSpec, camera_ids
from foredrive.data.category_names import category_or_other
from foredrive.data.formats.guard import reading_raw
from foredrive.data.formats.nuscenes_names import camera_of_channel, read_table
from foredrive.data.modalities import attributes_modality, visibility_modality
from foredrive.data.notices import note
from foredrive.data.written_boxes import LABEL_OF_CATEGORY
from foredrive.scene import Attribute
from foredrive.scene.boxes import UNKNOWN

Row = dict[str, Any]

LIDAR = "LIDAR_TOP"
MIDDLE_OF_LEVEL = {"1": 0.2, "2": 0.5, "3": 0.7, "4": 0.9, "": np.nan}
"""Visible share that stands for each level, by its token, which is empty where there are no levels."""
_ATTRIBUTE_OF_LABEL = {attribute.label: attribute for attribute in Attribute}
_MAX_APART_US = 50_000
"""Largest time between a sweep of the lidar and an image beside it, for frames that are no samples."""


@dataclass(frozen=True, eq=False)
class NuScenesTables:
    """The tables of a data set, by token, and the readings and boxes of each scene and sample."""

    rows: dict[str, dict[str, Row]]
    readings: dict[str, dict[str, list[Row]]]
    """Rows of `sample_data` in order of time, by scene and channel."""
    boxes: dict[str, list[Row]]
    """Rows of `sample_annotation` by sample."""

    def channel(self, reading: Row) -> str:
        """Return the channel of a reading."""
        return str(self.rows["sensor"][self.calibration(reading)["sensor_token"]]["channel"])

    def calibration(self, reading: Row) -> Row:
        """Return the row of `calibrated_sensor` of a reading."""
        return self.rows["calibrated_sensor"][reading["calibrated_sensor_token"]]

    def log(self, scene: Row) -> Row:
        """Return the row of `log` of a scene."""
        return self.rows["log"][scene["log_token"]]


@functools.lru_cache(maxsize=2)
def nuscenes_tables(folder: Path) -> NuScenesTables:
    """Read the tables of a data set. Those of the last two are kept: scenes are read one after the other."""
    rows = {
        file.stem: read_table(file) for file in sorted(folder.glob("*.json")) if file.name != "splits.json"
    }
    tables = NuScenesTables(rows, {}, {})
    # Readings of each scene and channel in order of time
    for reading in sorted(rows["sample_data"].values(), key=lambda row: int(row["timestamp"])):
        scene = rows["sample"][reading["sample_token"]]["scene_token"]
        of_scene = tables.readings.setdefault(scene, {})
        of_scene.setdefault(tables.channel(reading), []).append(reading)
    for box in rows.get("sample_annotation", {}).values():
        tables.boxes.setdefault(box["sample_token"], []).append(box)
    return tables


class NuScenesTablesParser(BaseLogParser):
    """Parser of one scene. Frames are those of LIDAR_TOP, or of the first camera where there is no lidar.

    Boxes are those of samples: frames between have none. The world frame is the data set's global frame; the
    offset by which `foredrive export nuscenes` moved it is undone.

    Args:
        tables: the folder v1.0-NAME.
        split: 123D split.
        scene_token: the scene.
        sweeps: whether the frames between samples are read too.
    """

    def __init__(self, tables: Path, split: str, scene_token: str, *, sweeps: bool) -> None:
        self._folder = tables
        self._split = split
        self._scene_token = scene_token
        self._sweeps = sweeps

    @property
    def _tables(self) -> NuScenesTables:
        return nuscenes_tables(self._folder)

    @property
    def _scene(self) -> Row:
        return self._tables.rows["scene"][self._scene_token]

    def get_log_metadata(self) -> LogMetadata:
        """Return the log's metadata with the scene's name."""
        location = self._tables.log(self._scene).get("location") or None
        return LogMetadata("nuscenes", self._split, self._scene["name"], location=location)

    def iter_modalities_sync(self) -> Iterator[ModalitiesSync]:
        """Yield the frames: ego pose at the time of the sweep, boxes, lidar, and the images beside it.

        Raises:
            InputError: a table is wrong.
        """
        frames = self._frames()
        while True:
            with reading_raw(self._folder):  # sensor files are read later
                frame = next(frames, None)
            if frame is None:
                return
            yield frame

    def _frames(self) -> Iterator[ModalitiesSync]:
        readings = self._tables.readings.get(self._scene_token, {})
        # The frames are those of the lidar, or of the camera with most images
        cameras = {camera_id: readings[name] for name, camera_id in self._camera_ids(readings).items()}
        frames = readings.get(LIDAR) or max(cameras.values(), key=len, default=[])
        for frame in frames:
            if not (frame["is_key_frame"] or self._sweeps):
                continue
            timestamp = Timestamp.from_us(frame["timestamp"])
            pose = pose_of_matrix(self._ego_pose(frame))
            modalities: list[BaseModality] = [
                EgoStateSE3.from_imu(pose, NUSCENES_EGO_STATE_SE3_METADATA, timestamp)
            ]
            # Only samples have boxes
            if frame["is_key_frame"]:
                modalities += self._boxes(frame["sample_token"], timestamp)
            if LIDAR in readings:
                modalities.append(self._lidar(frame))
            for camera_id, rows in cameras.items():
                beside = _beside(frame, rows)
                modalities += [] if beside is None else [self._camera(camera_id, beside)]
            yield ModalitiesSync(timestamp, modalities)

    def _camera_ids(self, readings: dict[str, list[Row]]) -> dict[str, CameraID]:
        """Return 123D's cameras of the channels with images: by the names of channels, else by direction."""
        specs, channels = [], {}
        for channel, rows in readings.items():
            calibration = self._tables.calibration(rows[0])
            modality = self._tables.rows["sensor"][calibration["sensor_token"]]["modality"]
            # What is neither a camera with intrinsics nor the lidar is left out, with a notice
            if modality != "camera" or not calibration["camera_intrinsic"]:
                if channel != LIDAR and modality != "radar":
                    lidar = f"the lidar that is read is {LIDAR}"
                    reason = "it has no intrinsics" if modality == "camera" else lidar
                    note(channel, f"left out; {reason}")
                continue
            named = camera_of_channel(channel)
            name = channel if named is None else named.name
            channels[name] = channel
            K = np.array(calibration["camera_intrinsic"], np.float64)
            specs.append(CameraSpec(name, K, matrix_of_row(calibration), (0, 0)))
        return {channels[spec.name]: camera_id for spec, camera_id in camera_ids(specs)}

    def _boxes(self, sample_token: str, timestamp: Timestamp) -> list[BaseModality]:
        """Return boxes, attributes and visibilities of a sample. Velocities follow from the tracks."""
        rows, tables = self._tables.boxes.get(sample_token, []), self._tables.rows
        names = {token: row["name"] for token, row in tables.get("attribute", {}).items()}
        detections = []
        for row in rows:
            category = tables["category"][tables["instance"][row["instance_token"]]["category_token"]]["name"]
            # Categories beyond nuScenes' own become the nearest one, or other
            label = NUSCENES_DETECTION_NAME_DICT.get(category)
            if label is None:
                label = LABEL_OF_CATEGORY[category_or_other(category, "sample_annotation")]
            width, length, height = row["size"]
            box = BoundingBoxSE3(pose_of_matrix(self._in_world(row)), length, width, height)
            described = BoxDetectionAttributes(label, row["instance_token"], row.get("num_lidar_pts"))
            detections.append(BoxDetectionSE3(described, box, None))
        return [
            BoxDetectionsSE3(detections, timestamp, NUSCENES_BOX_DETECTIONS_SE3_METADATA),
            attributes_modality([attribute_of_row(row, names) for row in rows], timestamp),
            visibility_modality([visible_share(row) for row in rows], timestamp),
        ]

    def _lidar(self, row: Row) -> ParsedLidar:
        mounted = pose_of_matrix(matrix_of_row(self._tables.calibration(row)))
        sensor = LidarMetadata(LIDAR, LidarID.LIDAR_TOP, mounted)
        return ParsedLidar(
            metadata=LidarMergedMetadata({LidarID.LIDAR_TOP: sensor}),
            start_timestamp=Timestamp.from_us(row["timestamp"] - NUSCENES_LIDAR_SWEEP_DURATION_US),
            end_timestamp=Timestamp.from_us(row["timestamp"]),
            dataset_root=self._folder.parent,
            relative_path=Path(row["filename"]),
        )

    def _camera(self, camera_id: CameraID, row: Row) -> ParsedCamera:
        calibration = self._tables.calibration(row)
        T_ego_cam = matrix_of_row(calibration)
        width, height = self._size(row)
        metadata = PinholeCameraMetadata(
            camera_name=self._tables.channel(row),
            camera_id=camera_id,
            intrinsics=PinholeIntrinsics.from_camera_matrix(np.array(calibration["camera_intrinsic"])),
            distortion=None,
            width=width,
            height=height,
            camera_to_imu_se3=pose_of_matrix(T_ego_cam),
            is_undistorted=True,
        )
        return ParsedCamera(
            metadata=metadata,
            timestamp=Timestamp.from_us(row["timestamp"]),
            camera_to_global_se3=pose_of_matrix(self._ego_pose(row) @ T_ego_cam),
            dataset_root=self._folder.parent,
            relative_path=Path(row["filename"]),
        )

    def _size(self, row: Row) -> tuple[int, int]:
        """Return width and height of an image, from its file where the table has none."""
        if row.get("width") and row.get("height"):
            return int(row["width"]), int(row["height"])
        with Image.open(self._folder.parent / row["filename"]) as opened:
            return opened.size

    def _ego_pose(self, reading: Row) -> np.ndarray:
        return self._in_world(self._tables.rows["ego_pose"][reading["ego_pose_token"]])

    def _in_world(self, row: Row) -> np.ndarray:
        """Return a pose of the global frame in the world frame."""
        T = matrix_of_row(row)
        # The export moved the global frame: undo it
        T[:2, 3] += self._tables.log(self._scene).get("world_offset_m", (0.0, 0.0))
        return T


def attribute_of_row(row: Row | None, names: dict[str, str]) -> int:
    """Return the `Attribute` of an annotation by the names of attributes, or UNKNOWN."""
    tokens = row.get("attribute_tokens") if row is not None else None
    return _ATTRIBUTE_OF_LABEL.get(names.get(tokens[0], ""), UNKNOWN) if tokens else UNKNOWN


def visible_share(row: Row) -> float:
    """Return the visible share of an annotation, NaN where no level is known."""
    return MIDDLE_OF_LEVEL.get(str(row.get("visibility_token") or ""), np.nan)


def matrix_of_row(row: Row) -> np.ndarray:
    """Return the pose of a row with translation and rotation as a matrix [4, 4]."""
    matrix: np.ndarray = PoseSE3(*row["translation"], *row["rotation"]).transformation_matrix
    if not np.isfinite(matrix).all():
        raise ValueError(f"the pose of the row {row['token']} is not finite")
    return matrix


def pose_of_matrix(T: np.ndarray) -> PoseSE3:
    """Return 123D's pose of a matrix [4, 4]."""
    return PoseSE3.from_transformation_matrix(T)


def _beside(frame: Row, rows: list[Row]) -> Row | None:
    """Return the reading of the same sample, or near to a frame between samples. None if there is none."""
    # At a sample, only images of the same sample belong to it
    if frame["is_key_frame"]:
        same = (row for row in rows if row["is_key_frame"] and row["sample_token"] == frame["sample_token"])
        return next(same, None)
    nearest = min(rows, key=lambda row: abs(row["timestamp"] - frame["timestamp"]))
    return nearest if abs(nearest["timestamp"] - frame["timestamp"]) <= _MAX_APART_US else None
