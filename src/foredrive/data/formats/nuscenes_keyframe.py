"""A 123D parser for single nuScenes key frames without the rest of the dataset.

py123d's own parser needs all nuScenes tables and the devkit. This parser reads a folder with the sensor files
of one key frame, its rows of the devkit's tables (v1.0-*/*.json), and its boxes in an info file of
mmdetection3d (*.pkl). The info file has no attributes and visibilities. They are read from the table
sample_annotation.json, if the folder has it.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
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
from py123d.datatypes.detections.box_detections_metadata import BoxDetectionsSE3Metadata
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.geometry import BoundingBoxSE3, Vector3D
from py123d.parser.base_dataset_parser import BaseLogParser, ModalitiesSync, ParsedCamera, ParsedLidar
from py123d.parser.nuscenes.utils.nuscenes_constants import (
    NUSCENES_BOX_DETECTIONS_SE3_METADATA,
    NUSCENES_CAMERA_IDS,
    NUSCENES_EGO_STATE_SE3_METADATA,
    NUSCENES_LIDAR_SWEEP_DURATION_US,
)
from scipy.spatial import KDTree

from foredrive.data.formats.nuscenes_tables import (
    attribute_of_row,
    matrix_of_row,
    pose_of_matrix,
    visible_share,
)
from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.modalities import attributes_modality, visibility_modality
from foredrive.data.safe_pickle import load_pickle
from foredrive.data.written_boxes import LABEL_OF_CATEGORY
from foredrive.scene import Category

_SAME_PLACE_M = 0.1


class NuScenesKeyframeParser(BaseLogParser):
    """Parser of one key frame as a log of one frame.

    Args:
        folder: contains v1.0-*/ with the tables, the info file, and the sensor files by their bare names.
        split: 123D split, e.g. nuscenes_val.
    """

    def __init__(self, folder: Path, split: str) -> None:
        self._folder = Path(folder)
        self._split = split
        tables = next(self._folder.glob("v1.0-*"))
        self._rows = {file.stem: json.loads(file.read_bytes()) for file in tables.glob("*.json")}

    def get_log_metadata(self) -> LogMetadata:
        """Return the log's metadata with the scene's name. The folder has no table with the location."""
        return LogMetadata("nuscenes", self._split, self._rows["scene"][0]["name"], location=None)

    def iter_modalities_sync(self) -> Iterator[ModalitiesSync]:
        """Yield the frame: ego pose at the lidar's time, boxes, lidar and six cameras."""
        # Rows of sample_data by the channel of their sensor
        by_channel = {self._channel(row): row for row in self._rows["sample_data"]}
        lidar = by_channel["LIDAR_TOP"]
        timestamp = Timestamp.from_us(lidar["timestamp"])
        T_world_ego = self._ego_pose(lidar)
        ego = EgoStateSE3.from_imu(pose_of_matrix(T_world_ego), NUSCENES_EGO_STATE_SE3_METADATA, timestamp)
        T_ego_lidar = matrix_of_row(self._calibration(lidar))
        boxes = self._boxes(T_world_ego @ T_ego_lidar, timestamp)
        cameras = [
            self._camera(camera_id, by_channel[channel])
            for camera_id, channel in NUSCENES_CAMERA_IDS.items()
            if channel in by_channel
        ]
        yield ModalitiesSync(
            timestamp,
            [
                ego,
                boxes,
                *self._labels(boxes),
                self._lidar(lidar, T_ego_lidar),
                *cameras,
            ],
        )

    def _boxes(self, T_world_lidar: np.ndarray, timestamp: Timestamp) -> BoxDetectionsSE3:
        info = load_pickle(next(self._folder.glob("*.pkl")))
        # Names of the classes by their numbers in the info file
        names = {number: name for name, number in info["metainfo"]["categories"].items()}
        detections = []
        for track, instance in enumerate(info["data_list"][0]["instances"]):
            *values, yaw = (float(value) for value in instance["bbox_3d"])  # lidar frame, z of the centre
            # Boxes are stored in the lidar's frame
            T = T_world_lidar @ _yaw_matrix(yaw, values[:3])
            velocity = T_world_lidar[:3, :3] @ [*(float(v) for v in instance["velocity"]), 0.0]
            name = names.get(instance["bbox_label_3d"], "other")
            attributes = BoxDetectionAttributes(
                LABEL_OF_CATEGORY[Category[name.upper()]], str(track), int(instance["num_lidar_pts"])
            )
            over_ground = Vector3D.from_array(velocity) if np.isfinite(velocity).all() else None
            detections.append(
                BoxDetectionSE3(attributes, BoundingBoxSE3(pose_of_matrix(T), *values[3:6]), over_ground)
            )
        metadata: BoxDetectionsSE3Metadata = NUSCENES_BOX_DETECTIONS_SE3_METADATA
        return BoxDetectionsSE3(detections, timestamp, metadata)

    def _labels(self, boxes: BoxDetectionsSE3) -> list[BaseModality]:
        """Return attributes and visibilities of the boxes from the annotations at the same places."""
        rows, detections = self._rows.get("sample_annotation", []), list(boxes.box_detections)
        if not rows or not detections:
            return []
        # The info file has no annotation tokens: annotations are found by their places
        centres = np.array([box.bounding_box_se3.center_se3.point_3d.array for box in detections])
        apart_m, nearest = KDTree([row["translation"] for row in rows]).query(centres)
        near_enough = (np.atleast_1d(apart_m) < _SAME_PLACE_M).tolist()
        matched = [
            rows[row_index] if near else None
            for row_index, near in zip(np.atleast_1d(nearest).tolist(), near_enough, strict=True)
        ]
        names = {row["token"]: row["name"] for row in self._rows["attribute"]}
        attributes = [attribute_of_row(row, names) for row in matched]
        shares = [visible_share(row) if row else np.nan for row in matched]
        return [
            attributes_modality(attributes, boxes.timestamp),
            visibility_modality(shares, boxes.timestamp),
        ]

    def _lidar(self, row: dict[str, Any], T_ego_lidar: np.ndarray) -> ParsedLidar:
        sensor = LidarMetadata("LIDAR_TOP", LidarID.LIDAR_TOP, pose_of_matrix(T_ego_lidar))
        return ParsedLidar(
            metadata=LidarMergedMetadata({LidarID.LIDAR_TOP: sensor}),
            start_timestamp=Timestamp.from_us(row["timestamp"] - NUSCENES_LIDAR_SWEEP_DURATION_US),
            end_timestamp=Timestamp.from_us(row["timestamp"]),
            dataset_root=self._folder,
            relative_path=Path(row["filename"]).name,
        )

    def _camera(self, camera_id: CameraID, row: dict[str, Any]) -> ParsedCamera:
        calibration = self._calibration(row)
        T_ego_cam = matrix_of_row(calibration)
        metadata = PinholeCameraMetadata(
            camera_name=NUSCENES_CAMERA_IDS[camera_id],
            camera_id=camera_id,
            intrinsics=PinholeIntrinsics.from_camera_matrix(np.array(calibration["camera_intrinsic"])),
            distortion=None,
            width=row["width"],
            height=row["height"],
            camera_to_imu_se3=pose_of_matrix(T_ego_cam),
            is_undistorted=True,
        )
        return ParsedCamera(
            metadata=metadata,
            timestamp=Timestamp.from_us(row["timestamp"]),
            camera_to_global_se3=pose_of_matrix(self._ego_pose(row) @ T_ego_cam),
            dataset_root=self._folder,
            relative_path=Path(row["filename"]).name,
        )

    def _channel(self, row: dict[str, Any]) -> str:
        sensor = _find(self._rows["sensor"], self._calibration(row)["sensor_token"])
        return str(sensor["channel"])

    def _calibration(self, row: dict[str, Any]) -> dict[str, Any]:
        return _find(self._rows["calibrated_sensor"], row["calibrated_sensor_token"])

    def _ego_pose(self, row: dict[str, Any]) -> np.ndarray:
        return matrix_of_row(_find(self._rows["ego_pose"], row["ego_pose_token"]))


def _find(rows: list[dict[str, Any]], token: str) -> dict[str, Any]:
    return next(row for row in rows if row["token"] == token)


def _yaw_matrix(yaw: float, xyz: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = xyz
    return T


def find_keyframes(source: Path) -> Iterator[RawLog]:
    """Yield the raw logs of a folder: of its root, of one log, or of one or two levels above them."""
    for folder in folders_with(source, "v1.0-*/sample_data.json"):
        yield RawLog(folder, NuScenesKeyframeParser(folder, "nuscenes_val"))
