"""Cameras of a 123D log: images of one size, intrinsics to match, motion-compensated extrinsics."""

import io
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from py123d.common.runtime import get_dataset_paths
from py123d.datatypes import CameraID, ModalityType, PinholeCameraMetadata
from torch import Tensor

from foredrive.data.logs import Log, reading
from foredrive.errors import InputError

_log = logging.getLogger(__name__)

_ROWS_EXPOSED_S = {"pandaset": (-0.03, 0.01)}
"""When the first and the last image row are exposed, relative to the time that the data set gives the image.
PandaSet: neurad-studio's PandaSetDataParserConfig.rolling_shutter_offsets; in a moving log, lidar intensity
against image brightness bears them out row by row. Data sets not listed: all rows at the given time."""


@dataclass(frozen=True)
class CameraFrame:
    """One camera at one frame."""

    image: UInt8[Tensor, "3 H W"] | None
    """RGB; None if the log has none at this frame or it was not asked for."""
    K: Float[Tensor, "3 3"]
    T_ego_cam: Float[Tensor, "4 4"]
    """From the camera at the time of its middle row."""
    dist: Float[Tensor, "5"]
    readout_s: float


def pinhole_cameras(log: Log) -> dict[str, PinholeCameraMetadata]:
    """A log's pinhole cameras by their own names, front first; cameras of other models are passed over."""
    cameras = {}
    for key, metadata in log.scene.get_all_modality_metadatas().items():
        if metadata.modality_type != ModalityType.CAMERA:
            continue
        if isinstance(metadata, PinholeCameraMetadata) and metadata.intrinsics is not None:
            cameras[metadata.camera_name] = metadata
        else:
            _log.warning("%s: %s is not a pinhole camera and is left out", log.path.folder, key)
    return dict(sorted(cameras.items(), key=lambda item: int(item[1].camera_id)))


def find_camera(cameras: dict[str, PinholeCameraMetadata], name: str) -> PinholeCameraMetadata | None:
    """A camera by its own name ("CAM_FRONT") or by 123D's ("pcam_f0"), which all data sets share."""
    by_id = {metadata.camera_id.serialize(): metadata for metadata in cameras.values()}
    return cameras.get(name) or by_id.get(name)


def read_camera(
    log: Log, frame: int, metadata: PinholeCameraMetadata, image_hw: tuple[int, int], with_image: bool
) -> CameraFrame:
    """Read one camera at one frame, resized to `image_hw`.

    `T_ego_cam` takes the camera at its own exposure (of the middle row) to the ego frame at the frame's time.

    Raises:
        InputError: on an image that cannot be decoded or a pose that is not finite.
    """
    file = log.file(metadata.modality_key)
    T_ego_cam = np.linalg.inv(log.T_imu_ego) @ metadata.camera_to_imu_se3.transformation_matrix
    first_s, last_s = _ROWS_EXPOSED_S.get(log.metadata.dataset, (0.0, 0.0))
    at = (log.iteration(frame), ModalityType.CAMERA, metadata.camera_id)
    data = None
    with reading(file, f"frame {frame}"):
        pose = _column(log, *at, "camera_to_global_se3", deserialize=True)
        if pose is not None:
            T_ego_cam = np.linalg.inv(log.T_world_ego[frame]) @ pose.transformation_matrix
        if pose is not None and first_s != -last_s:
            stamp_us = float(_column(log, *at, "timestamp_us"))
            T_ego_cam = log.motion(frame, stamp_us, stamp_us + 0.5e6 * (first_s + last_s)) @ T_ego_cam
        if with_image:
            data = _column(log, *at, "data")
    if not np.isfinite(T_ego_cam).all():
        raise InputError(f"{file}: the camera pose at frame {frame} is not finite")
    image = None
    if data is not None:
        with reading(file, f"the image at frame {frame}"):
            image = _resize(_open_image(log, frame, metadata, data), image_hw)
    dist = metadata.distortion
    ideal = metadata.is_undistorted or dist is None
    return CameraFrame(
        image=image,
        K=_scaled_intrinsics(metadata, image_hw),
        T_ego_cam=torch.from_numpy(T_ego_cam).float(),
        dist=torch.zeros(5) if ideal else torch.from_numpy(dist.array.copy()).float(),
        readout_s=last_s - first_s,
    )


def _column(
    log: Log, iteration: int, kind: ModalityType, camera_id: CameraID, name: str, deserialize: bool = False
) -> Any:
    return log.scene.get_modality_column_at_iteration(iteration, name, kind, camera_id, deserialize)


def _scaled_intrinsics(metadata: PinholeCameraMetadata, image_hw: tuple[int, int]) -> Float[Tensor, "3 3"]:
    scale = torch.tensor([image_hw[1] / metadata.width, image_hw[0] / metadata.height, 1.0])
    return scale[:, None] * torch.from_numpy(metadata.intrinsics.camera_matrix).float()


def _open_image(
    log: Log, frame: int, metadata: PinholeCameraMetadata, data: bytes | str | int
) -> Image.Image:
    """An image as 123D stores it: encoded bytes, a path under the data set's root, or a video's frame."""
    if isinstance(data, bytes):
        return Image.open(io.BytesIO(data))
    if isinstance(data, str):
        root = get_dataset_paths().get_sensor_root(log.metadata.dataset)
        if root is None:
            raise InputError(
                f"{log.file(metadata.modality_key)}: the images lie outside the log; set the environment "
                f"variable of the {log.metadata.dataset} folder, or convert the log with its images in it"
            )
        return Image.open(Path(root) / data)
    camera = log.scene.get_camera_at_iteration(log.iteration(frame), metadata.camera_id)
    return Image.fromarray(camera.image)


def _resize(image: Image.Image, image_hw: tuple[int, int]) -> UInt8[Tensor, "3 H W"]:
    """Antialiased resize; JPEGs are decoded at the smallest scale (1, 1/2, 1/4, 1/8) that is large enough.

    A JPEG whose size is no multiple of the scale comes with a part of a pixel too much, which is left out.
    """
    size_wh = image_hw[::-1]
    drafted = image.draft("RGB", size_wh)
    region = drafted[1] if drafted is not None else (0, 0, *image.size)
    resized = image.convert("RGB").resize(size_wh, Image.Resampling.BILINEAR, box=region)
    return torch.from_numpy(np.array(resized).transpose(2, 0, 1).copy())
