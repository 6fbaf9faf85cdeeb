"""A 123D parser for frames of KITTI's object benchmark (Geiger et al. 2012), which belong to no drive.

Each frame of training/ or testing/ (image_2, image_3 if present, velodyne, calib, label_2) becomes a log of
one frame. Its time and place are unknown, so the time is 0 and the origin of the world is the IMU.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from PIL import Image
from py123d.datatypes import (
    BoxDetectionAttributes,
    BoxDetectionSE3,
    BoxDetectionsSE3,
    Camera,
    CameraID,
    EgoStateSE3,
    Lidar,
    LidarID,
    LidarMetadata,
    LogMetadata,
    PinholeCameraMetadata,
    PinholeIntrinsics,
    Timestamp,
)
from py123d.datatypes.detections.box_detections_metadata import BoxDetectionsSE3Metadata
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.geometry import BoundingBoxSE3, PoseSE3
from py123d.parser.base_dataset_parser import BaseLogParser, ModalitiesSync
from py123d.parser.kitti360.utils.kitti360_constants import KITTI360_EGO_STATE_SE3_METADATA
from py123d.parser.registry import NuScenesBoxDetectionLabel

from foredrive.data.modalities import attributes_modality
from foredrive.data.written_boxes import LABEL_OF_CATEGORY
from foredrive.scene import Attribute, Category
from foredrive.scene.boxes import UNKNOWN

_NOW = Timestamp.from_us(0)
_CAMERAS = {"image_2": ("P2", CameraID.PCAM_STEREO_L), "image_3": ("P3", CameraID.PCAM_STEREO_R)}
_CATEGORY = {
    "Car": Category.CAR,
    "Van": Category.CAR,
    "Truck": Category.TRUCK,
    "Pedestrian": Category.PEDESTRIAN,
    "Person_sitting": Category.PEDESTRIAN,
    "Cyclist": Category.BICYCLE,
    "Tram": Category.OTHER,
    "Misc": Category.OTHER,
}
_ATTRIBUTE = {
    "Cyclist": Attribute.CYCLE_WITH_RIDER,
    "Person_sitting": Attribute.PEDESTRIAN_SITTING_LYING_DOWN,
}
"""nuScenes' attributes that a class of KITTI implies. KITTI's levels of occlusion are no shares, so the
visibility stays unknown."""
_NOT_LABELLED = "DontCare"


class KittiObjectParser(BaseLogParser):
    """Parser of one frame as a log. The vehicle is that of KITTI-360, which is the same.

    Args:
        folder: training/ or testing/.
        frame: number, such as 000008.
        split: 123D split, e.g. kitti_train.
    """

    def __init__(self, folder: Path, frame: str, split: str) -> None:
        self._folder, self._frame, self._split = Path(folder), frame, split

    def get_log_metadata(self) -> LogMetadata:
        """Return the log's metadata. Its name is the frame's number."""
        return LogMetadata("kitti", self._split, self._frame, location=None)

    def iter_modalities_sync(self) -> Iterator[ModalitiesSync]:
        """Yield the frame: lidar, cameras and, for training frames, boxes."""
        calibration = _Calibration.read(self._file("calib", "txt"))
        ego = EgoStateSE3.from_imu(PoseSE3.identity(), KITTI360_EGO_STATE_SE3_METADATA, _NOW)
        found: list[BaseModality] = [ego, self._lidar(calibration)]
        for kind in _CAMERAS:
            if self._file(kind, "png").is_file():
                found.append(self._camera(kind, calibration))
        if self._file("label_2", "txt").is_file():
            found += self._boxes(calibration)
        yield ModalitiesSync(_NOW, found)

    def _lidar(self, calibration: "_Calibration") -> Lidar:
        points = np.fromfile(self._file("velodyne", "bin"), dtype=np.float32).reshape(-1, 4)
        T = calibration.T_imu_velo
        return Lidar(
            timestamp=_NOW,
            timestamp_end=_NOW,
            metadata=LidarMetadata("velodyne", LidarID.LIDAR_TOP, _pose(T)),
            point_cloud_3d=(points[:, :3] @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
            point_cloud_features={"intensity": np.round(points[:, 3] * 255).astype(np.uint8)},
        )

    def _camera(self, kind: str, calibration: "_Calibration") -> Camera:
        name, camera_id = _CAMERAS[kind]
        with Image.open(self._file(kind, "png")) as opened:
            image = np.asarray(opened.convert("RGB"))
        K, T_imu_cam = calibration.camera(name)
        metadata = PinholeCameraMetadata(
            camera_name=kind,
            camera_id=camera_id,
            intrinsics=PinholeIntrinsics.from_camera_matrix(K),
            distortion=None,
            width=image.shape[1],
            height=image.shape[0],
            camera_to_imu_se3=_pose(T_imu_cam),
            is_undistorted=True,
        )
        return Camera(metadata, image, _pose(T_imu_cam), _NOW)

    def _boxes(self, calibration: "_Calibration") -> list[BaseModality]:
        """Return the boxes and their attributes."""
        detections, known = [], []
        for number, line in enumerate(self._file("label_2", "txt").read_text().splitlines()):
            kind, *words = line.split()
            if kind == _NOT_LABELLED:
                continue
            height, width, length, x, y, z, turn = (float(word) for word in words[7:14])
            T_rect_box = np.eye(4)  # box axes: forward, left, up; `turn` is about y, which points down
            T_rect_box[:3, 0] = [np.cos(turn), 0.0, -np.sin(turn)]
            T_rect_box[:3, 1] = [np.sin(turn), 0.0, np.cos(turn)]
            T_rect_box[:3, 2] = [0.0, -1.0, 0.0]
            T_rect_box[:3, 3] = [x, y - 0.5 * height, z]  # labels give the centre of the bottom face
            pose = _pose(calibration.T_imu_rect @ T_rect_box)
            attributes = BoxDetectionAttributes(LABEL_OF_CATEGORY[_CATEGORY[kind]], str(number), None)
            detections.append(BoxDetectionSE3(attributes, BoundingBoxSE3(pose, length, width, height), None))
            known.append(_ATTRIBUTE.get(kind, UNKNOWN))
        boxes = BoxDetectionsSE3(detections, _NOW, BoxDetectionsSE3Metadata(NuScenesBoxDetectionLabel))
        return [boxes, attributes_modality(known, _NOW)]

    def _file(self, kind: str, suffix: str) -> Path:
        return self._folder / kind / f"{self._frame}.{suffix}"


@dataclass(frozen=True)
class _Calibration:
    """The calibration of one frame. "rect" is the rectified frame of camera 0, in which boxes are given."""

    T_imu_velo: Float64[np.ndarray, "4 4"]
    T_imu_rect: Float64[np.ndarray, "4 4"]
    projections: dict[str, Float64[np.ndarray, "3 4"]]

    @classmethod
    def read(cls, file: Path) -> "_Calibration":
        """Read a calibration file."""
        values = {}
        for line in file.read_text().splitlines():
            name, _, numbers = line.partition(":")
            if numbers:
                values[name] = np.array([float(word) for word in numbers.split()])
        T_imu_velo = np.linalg.inv(_rigid(values["Tr_imu_to_velo"].reshape(3, 4)))
        T_rect_velo = _rigid(values["R0_rect"].reshape(3, 3)) @ _rigid(values["Tr_velo_to_cam"].reshape(3, 4))
        projections = {name: values[name].reshape(3, 4) for name, _ in _CAMERAS.values()}
        return cls(T_imu_velo, T_imu_velo @ np.linalg.inv(T_rect_velo), projections)

    def camera(self, name: str) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "4 4"]]:
        """Return K and T_imu_cam of a camera. Its projection matrix contains its offset from camera 0."""
        P = self.projections[name]
        T_cam_rect = np.eye(4)
        T_cam_rect[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
        return P[:, :3], self.T_imu_rect @ np.linalg.inv(T_cam_rect)


def _rigid(rows: Float64[np.ndarray, "3 _"]) -> Float64[np.ndarray, "4 4"]:
    """Return a rotation (and offset) as a 4×4 matrix.

    The rotation is orthonormalised, because the files have only seven digits.
    """
    T = np.eye(4)
    U, _, V = np.linalg.svd(rows[:, :3])
    T[:3, :3] = U @ V
    T[:3, 3:] = rows[:, 3:] if rows.shape[1] == 4 else 0.0
    return T


def _pose(T: Float64[np.ndarray, "4 4"]) -> PoseSE3:
    return PoseSE3.from_transformation_matrix(T)
