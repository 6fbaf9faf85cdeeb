"""Cameras in 123D's terms: ids, geometry, and the label images with the same geometry."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from py123d.datatypes import (
    CameraChannelType,
    CameraID,
    DefaultCameraSegmentationLabel,
    DepthCameraMetadata,
    PinholeCameraMetadata,
    PinholeDistortion,
    PinholeIntrinsics,
    SegmentationCameraMetadata,
)
from py123d.geometry import PoseSE3

from foredrive.errors import InputError

DEPTH_STEP_M = 0.01
_DEPTH_CODES = 2**16 - 2
"""Number of depth values. Code 0 means "no depth"."""

CAMERA_NAMES = tuple(CameraID.__members__)
"""123D's names of cameras."""
_CAMERA_IDS_LEFT = (CameraID.PCAM_L0, CameraID.PCAM_L1, CameraID.PCAM_L2)
_CAMERA_IDS_RIGHT = (CameraID.PCAM_R0, CameraID.PCAM_R1, CameraID.PCAM_R2)
_CAMERA_IDS_SPARE = (CameraID.PCAM_STEREO_L, CameraID.PCAM_STEREO_R, CameraID.PCAM_D0)
_AHEAD_RAD = np.deg2rad(22.5)


@dataclass(frozen=True)
class CameraSpec:
    """A pinhole camera, fixed to the vehicle."""

    name: str
    K: Float[np.ndarray, "3 3"]
    """Intrinsics, px, pixel centres at +0.5."""
    T_ego_cam: Float[np.ndarray, "4 4"]
    size_hw: tuple[int, int]
    readout_s: float = 0.0
    """Time from the exposure of the first row to that of the last, s. The middle row is exposed at the
    frame's time. 0 is a global shutter."""
    dist: Float[np.ndarray, "5"] | None = None
    """OpenCV's k1 k2 p1 p2 k3. None is an ideal pinhole."""


class RollingCameraMetadata(PinholeCameraMetadata):
    """123D's metadata of a pinhole camera, extended by the readout time, which 123D does not store."""

    __slots__ = ("readout_s",)

    def __init__(self, readout_s: float, **described: Any) -> None:
        super().__init__(**described)
        self.readout_s = readout_s

    @classmethod
    def from_dict(cls, data_dict: dict[str, Any]) -> "RollingCameraMetadata":
        """Read a log's metadata. Without a readout time the shutter is global."""
        pinhole = PinholeCameraMetadata.from_dict(data_dict)
        described = {slot[1:]: getattr(pinhole, slot) for slot in PinholeCameraMetadata.__slots__}
        return cls(data_dict.get("readout_s", 0.0), **described)

    def to_dict(self) -> dict[str, Any]:
        """Return 123D's dictionary with the readout time."""
        return {**super().to_dict(), "readout_s": self.readout_s}


def camera_metadata(spec: CameraSpec, camera_id: CameraID) -> RollingCameraMetadata:
    """Return 123D's metadata of a camera."""
    return RollingCameraMetadata(
        spec.readout_s,
        camera_name=spec.name,
        camera_id=camera_id,
        intrinsics=PinholeIntrinsics.from_camera_matrix(spec.K.astype(np.float64)),
        distortion=None if spec.dist is None else PinholeDistortion.from_array(spec.dist.astype(np.float64)),
        width=spec.size_hw[1],
        height=spec.size_hw[0],
        camera_to_imu_se3=PoseSE3.from_transformation_matrix(spec.T_ego_cam.astype(np.float64)),
        is_undistorted=spec.dist is None,
    )


def camera_ids(cameras: list[CameraSpec]) -> list[tuple[CameraSpec, CameraID]]:
    """Assign a 123D id to each camera: that of its name in any case, else one by its viewing direction.

    The ids by direction are front, back, and left and right, numbered from front to back.
    """
    azimuth = {c.name: float(np.arctan2(c.T_ego_cam[1, 2], c.T_ego_cam[0, 2])) for c in cameras}
    spare = [*_CAMERA_IDS_SPARE, *_CAMERA_IDS_LEFT[::-1], *_CAMERA_IDS_RIGHT[::-1]]
    if len(azimuth) < len(cameras):
        raise InputError(f"camera names are not unique: {[c.name for c in cameras]}")
    by_name = CameraID.__members__
    # Cameras with a name of 123D keep that id; the others share what is left
    named = [camera for camera in cameras if camera.name.upper() in by_name]
    taken = {by_name[camera.name.upper()]: camera for camera in named}
    if len(taken) < len(named):
        raise InputError(f"camera names are not unique: {[c.name for c in named]}")
    unnamed = [camera for camera in cameras if camera.name.upper() not in by_name]
    left_over = []
    # From front to back, so that side cameras are numbered in this order
    for camera in sorted(unnamed, key=lambda c: abs(azimuth[c.name])):
        angle = azimuth[camera.name]
        if abs(angle) <= _AHEAD_RAD:
            wanted: tuple[CameraID, ...] = (CameraID.PCAM_F0,)
        elif abs(angle) >= np.pi - _AHEAD_RAD:
            wanted = (CameraID.PCAM_B0,)
        else:
            wanted = _CAMERA_IDS_LEFT if angle > 0 else _CAMERA_IDS_RIGHT
        free = [id_ for id_ in wanted if id_ not in taken]
        if free:
            taken[free[0]] = camera
        else:
            left_over.append(camera)
    for camera in left_over:
        free = [id_ for id_ in spare if id_ not in taken]
        if not free:
            raise InputError(f"123D supports at most 11 cameras, got {len(cameras)}")
        taken[free[0]] = camera
    return [(camera, id_) for id_, camera in taken.items()]


def depth_metadata(camera: PinholeCameraMetadata) -> DepthCameraMetadata:
    """Return metadata of depth images.

    Depth is along the optical axis, in steps of `DEPTH_STEP_M` up to 655 m. The sky is NaN.
    """
    return DepthCameraMetadata(camera, max_depth=DEPTH_STEP_M * _DEPTH_CODES, has_invalid=True)


def semantic_metadata(camera: PinholeCameraMetadata) -> SegmentationCameraMetadata:
    """Return metadata of semantic images with 123D's own classes."""
    return SegmentationCameraMetadata(camera, DefaultCameraSegmentationLabel, CameraChannelType.SEMANTIC)


def instance_metadata(camera: PinholeCameraMetadata) -> SegmentationCameraMetadata:
    """Return metadata of instance images with the track ids of the boxes. 0 is outside all boxes."""
    return SegmentationCameraMetadata(camera, DefaultCameraSegmentationLabel, CameraChannelType.INSTANCE)
