"""A 123D parser for frames of KITTI's object benchmark (Geiger et al. 2012), which belong to no drive.

Each frame of training/ or testing/ becomes a log of one frame. It has a file in calib/, and in image_2/,
image_3/, velodyne/ and label_2/ where the frame has images, points and labels. Its time and place are
unknown, so the time is 0 and the origin of the world is the IMU. Exports of other data sets in this format
are read too: images of any kind, calibrations without IMU.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
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

from foredrive.data.category_names import category_or_other
from foredrive.data.formats.guard import PartReader
from foredrive.data.formats.point_files import KITTI, IntensityScale, read_points
from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.images import is_image, read_rgb
from foredrive.data.logs import imu_from_ego
from foredrive.data.modalities import attributes_modality
from foredrive.data.notices import note
from foredrive.data.written_boxes import LABEL_OF_CATEGORY
from foredrive.errors import InputError
from foredrive.scene import Attribute
from foredrive.scene.boxes import UNKNOWN

_NOW = Timestamp.from_us(0)
_CAMERAS = {"image_2": ("P2", CameraID.PCAM_STEREO_L), "image_3": ("P3", CameraID.PCAM_STEREO_R)}
_ATTRIBUTE = {
    "Cyclist": Attribute.CYCLE_WITH_RIDER,
    "Person_sitting": Attribute.PEDESTRIAN_SITTING_LYING_DOWN,
}
"""nuScenes' attributes that a class of KITTI implies. KITTI's levels of occlusion are no shares, so the
visibility stays unknown."""
_NOT_LABELLED = "DontCare"
_COLUMNS = 15
"""Class, truncation, occlusion, alpha, box in the image, size, place and turn of a label; more may follow."""
_HEIGHT_M = 1.73
"""Height of the lidar of KITTI above the ground, which stands for that of a lidar whose mount no file has."""


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
        """Yield the frame with the lidar, cameras and boxes that it has."""
        calibration = _Calibration.read(self._file("calib", "txt"))
        modalities: list[BaseModality] = [
            EgoStateSE3.from_imu(PoseSE3.identity(), KITTI360_EGO_STATE_SE3_METADATA, _NOW)
        ]
        if self._file("velodyne", "bin").is_file():
            modalities.append(self._lidar(calibration))
        for kind in _CAMERAS:
            files = sorted((self._folder / kind).glob(f"{self._frame}.*"))
            image = next((file for file in files if is_image(file)), None)
            if image is not None:
                modalities.append(self._camera(kind, image, calibration))
        if self._file("label_2", "txt").is_file():
            modalities += self._boxes(calibration)
        yield ModalitiesSync(_NOW, modalities)

    def _lidar(self, calibration: "_Calibration") -> Lidar:
        file = self._file("velodyne", "bin")
        points = read_points(file, KITTI)
        # Points are stored in the IMU's frame
        T = calibration.T_imu_velo
        intensity = IntensityScale(f"velodyne/{file.name}")(points[:, 3])
        return Lidar(
            timestamp=_NOW,
            timestamp_end=_NOW,
            metadata=LidarMetadata("velodyne", LidarID.LIDAR_TOP, _pose(T)),
            point_cloud_3d=(points[:, :3] @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
            point_cloud_features={"intensity": np.round(intensity * 255).astype(np.uint8)},
        )

    def _camera(self, kind: str, file: Path, calibration: "_Calibration") -> Camera:
        name, camera_id = _CAMERAS[kind]
        image = read_rgb(file)
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
        """Return the boxes and their attributes. Rows that are no boxes are left out."""
        file = self._file("label_2", "txt")
        detections, kinds = [], []
        read = PartReader(f"label_2/{file.name}", "rows")
        for number, line in enumerate(file.read_text(encoding="utf-8-sig").splitlines()):
            if not line.strip() or line.split()[0] == _NOT_LABELLED:
                continue
            label = read(f"line {number + 1}", functools.partial(_Label.of, line))
            if label is None:
                continue
            # Camera frame to IMU frame
            pose = _pose(calibration.T_imu_rect @ label.T_rect_box)
            category = category_or_other(label.kind, f"label_2/{file.name}")
            attributes = BoxDetectionAttributes(LABEL_OF_CATEGORY[category], str(number), None)
            box = BoundingBoxSE3(pose, *label.size_lwh_m)
            detections.append(BoxDetectionSE3(attributes, box, None))
            kinds.append(_ATTRIBUTE.get(label.kind, UNKNOWN))
        read.check()
        boxes = BoxDetectionsSE3(detections, _NOW, BoxDetectionsSE3Metadata(NuScenesBoxDetectionLabel))
        return [boxes, attributes_modality(kinds, _NOW)]

    def _file(self, kind: str, suffix: str) -> Path:
        return self._folder / kind / f"{self._frame}.{suffix}"


@dataclass(frozen=True)
class _Label:
    """One labelled object."""

    kind: str
    size_lwh_m: tuple[float, float, float]
    T_rect_box: Float64[np.ndarray, "4 4"]
    """Box axes: forward, left, up. The origin is the centre of the box."""

    @classmethod
    def of(cls, line: str) -> "_Label":
        """Return the object of a row of a label file.

        Raises:
            InputError: it is no such row, or the object has no size.
        """
        kind, *words = line.split()
        if len(words) < _COLUMNS - 1 or kind.replace(".", "").lstrip("-").isdigit():
            raise InputError(f"not {_COLUMNS} columns that begin with a class")
        # Order of KITTI's columns: height, width, length, then place and turn
        height, width, length, x, y, z, turn = (float(word) for word in words[7:14])
        if not np.isfinite([x, y, z, turn]).all() or not min(height, width, length) > 0:
            raise InputError("an object without place or size")
        T_rect_box = np.eye(4)  # `turn` is about y of the camera, which points down
        T_rect_box[:3, 0] = [np.cos(turn), 0.0, -np.sin(turn)]
        T_rect_box[:3, 1] = [np.sin(turn), 0.0, np.cos(turn)]
        T_rect_box[:3, 2] = [0.0, -1.0, 0.0]
        T_rect_box[:3, 3] = [x, y - 0.5 * height, z]  # labels give the centre of the bottom face
        return cls(kind, (length, width, height), T_rect_box)


@dataclass(frozen=True)
class _Calibration:
    """The calibration of one frame. "rect" is the rectified frame of camera 0, in which boxes are given."""

    T_imu_velo: Float64[np.ndarray, "4 4"]
    T_imu_rect: Float64[np.ndarray, "4 4"]
    projections: dict[str, Float64[np.ndarray, "3 4"]]

    @classmethod
    def read(cls, file: Path) -> "_Calibration":
        """Read a calibration file. Without Tr_imu_to_velo the ego frame is `_HEIGHT_M` below the lidar."""
        values = {}
        for line in file.read_text(encoding="utf-8-sig").splitlines():
            name, _, numbers = line.partition(":")
            if numbers:
                values[name.strip()] = np.array([float(word) for word in numbers.split()])
        if "Tr_imu_to_velo" in values:
            T_imu_velo = np.linalg.inv(_rigid(values["Tr_imu_to_velo"].reshape(3, 4)))
        else:
            text = f"no Tr_imu_to_velo; the ego frame is taken to be {_HEIGHT_M} m below the lidar"
            note(f"calib/{file.name}", text)
            T_ego_velo = np.eye(4)
            T_ego_velo[2, 3] = _HEIGHT_M
            T_imu_velo = imu_from_ego(KITTI360_EGO_STATE_SE3_METADATA) @ T_ego_velo
        # Velodyne to camera 0, then to the rectified frame
        T_rect_velo = _rigid(values["R0_rect"].reshape(3, 3)) @ _rigid(values["Tr_velo_to_cam"].reshape(3, 4))
        projections = {name: values[name].reshape(3, 4) for name, _ in _CAMERAS.values() if name in values}
        return cls(T_imu_velo, T_imu_velo @ np.linalg.inv(T_rect_velo), projections)

    def camera(self, name: str) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "4 4"]]:
        """Return K and T_imu_cam of a camera. Its projection matrix contains its offset from camera 0."""
        P = self.projections[name]
        T_cam_rect = np.eye(4)
        # P = K [I | t]: the offset of the camera from camera 0, in its own axes
        T_cam_rect[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
        return P[:, :3], self.T_imu_rect @ np.linalg.inv(T_cam_rect)


def _rigid(rows: Float64[np.ndarray, "3 _"]) -> Float64[np.ndarray, "4 4"]:
    """Return a rotation (and offset) as a 4×4 matrix.

    The rotation is orthonormalised, because the files have only seven digits.
    """
    T = np.eye(4)
    U, _, V = np.linalg.svd(rows[:, :3])
    # The nearest rotation
    T[:3, :3] = U @ V
    T[:3, 3:] = rows[:, 3:] if rows.shape[1] == 4 else 0.0
    return T


def _pose(T: Float64[np.ndarray, "4 4"]) -> PoseSE3:
    return PoseSE3.from_transformation_matrix(T)


def find_kitti_object(source: Path) -> Iterator[RawLog]:
    """Yield the raw logs of a folder: of its root, of one log, or of one or two levels above them."""
    for folder in folders_with(source, "calib"):
        split = "kitti_test" if folder.name == "testing" else "kitti_train"
        sensed = {file.stem for file in folder.glob("velodyne/*.bin")}
        sensed |= {file.stem for file in folder.glob("image_2/*") if is_image(file)}
        for frame in sorted(name for name in sensed if not name.startswith(".")):
            yield RawLog(folder, KittiObjectParser(folder, frame, split))
