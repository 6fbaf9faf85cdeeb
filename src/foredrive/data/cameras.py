"""Cameras of a 123D log: resized images, matching intrinsics, motion-compensated extrinsics."""

import functools
import io
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, UInt8
from PIL import Image, UnidentifiedImageError
from py123d.api.scene.arrow.modalities.sync_utils import get_modality_table
from py123d.api.utils.arrow_metadata_utils import get_metadata_from_arrow_schema
from py123d.common.runtime import get_dataset_paths
from py123d.datatypes import ModalityType, PinholeCameraMetadata
from torch import Tensor

from foredrive.data.arrow_files import column_array, fixed_lists, pose_matrices, reading
from foredrive.data.camera_streams import RollingCameraMetadata
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.scene import CameraRig
from foredrive.sensors.rigs import RigPlan, rig_of_cameras

_log = logging.getLogger(__name__)

_ROWS_EXPOSED_S = {"pandaset": (-0.03, 0.01)}
"""Exposure times of the first and the last image row, relative to the dataset's image time. The values of
PandaSet are neurad-studio's PandaSetDataParserConfig.rolling_shutter_offsets. Lidar intensity compared with
image brightness, row by row in a moving log, confirms them. For other datasets, all rows are exposed at the
image time, or centred on it if the log has a readout time."""


@dataclass(frozen=True)
class CameraFrame:
    """One camera at one frame."""

    image: UInt8[Tensor, "3 H W"] | None
    """RGB. None if the log has no image at this frame or it was not requested."""
    K: Float[Tensor, "3 3"]
    T_ego_cam: Float[Tensor, "4 4"]
    """Pose of the camera at the exposure of its middle row."""
    dist: Float[Tensor, "5"]
    readout_s: float
    exposed_dt_s: float
    """Exposure time of the middle row relative to the frame's time, s. 0 if there is no image."""


def pinhole_cameras(log: Log) -> dict[str, PinholeCameraMetadata]:
    """Return the pinhole cameras of a log by their own names, front first. Other cameras are skipped."""
    cameras = {}
    for key, metadata in log.scene.get_all_modality_metadatas().items():
        if metadata.modality_type != ModalityType.CAMERA:
            continue
        if isinstance(metadata, PinholeCameraMetadata) and metadata.intrinsics is not None:
            cameras[metadata.camera_name] = metadata
        else:
            _log.warning("%s: %s is not a pinhole camera and is left out", log.path.folder, key)
    return dict(sorted(cameras.items(), key=lambda item: int(item[1].camera_id)))


def rig_of_log(log: Log) -> RigPlan:
    """Return the places and fields of view of a log's cameras, by 123D's names, front first.

    Distortion and principal points are left out. The size is that of the first camera's images.

    Raises:
        InputError: the log has no pinhole cameras.
    """
    cameras = pinhole_cameras(log).values()
    if not cameras:
        raise InputError(f"{log.path.folder}: no pinhole cameras")
    mounted = [camera_mount(log, camera) for camera in cameras]
    height, width = next((camera.height, camera.width) for camera in cameras)
    return rig_of_cameras(
        CameraRig(
            K=torch.stack([_scaled_intrinsics(camera, (height, width)) for camera in cameras]),
            T_ego_cam=torch.from_numpy(np.stack(mounted)),
            dist=torch.zeros(len(cameras), 5),
            readout_s=torch.zeros(len(cameras)),
            names=tuple(camera.camera_id.name for camera in cameras),
            size_hw=(height, width),
        )
    )


def camera_mount(log: Log, metadata: PinholeCameraMetadata) -> Float64[np.ndarray, "4 4"]:
    """Return `T_ego_cam` of a camera at rest: its static extrinsic matrix."""
    # 123D stores extrinsics relative to the vehicle's IMU frame
    mounted: np.ndarray = np.linalg.inv(log.T_imu_ego) @ metadata.camera_to_imu_se3.transformation_matrix
    return mounted


def find_camera(cameras: dict[str, PinholeCameraMetadata], name: str) -> PinholeCameraMetadata | None:
    """Find a camera by its own name ("CAM_FRONT") or by 123D's name ("pcam_f0"), common to all datasets.

    Upper and lower case are not distinguished.
    """
    by_id = {metadata.camera_id.serialize().lower(): metadata for metadata in cameras.values()}
    by_name = {own.lower(): metadata for own, metadata in cameras.items()}
    return by_name.get(name.lower()) or by_id.get(name.lower())


def names_of_camera(log: Log, name: str) -> tuple[str, ...]:
    """Return all names by which `find_camera` finds a camera; none if the log has no such camera."""
    metadata = find_camera(pinhole_cameras(log), name)
    return () if metadata is None else (metadata.camera_name, metadata.camera_id.serialize())


def camera_list(cameras: Iterable[PinholeCameraMetadata]) -> str:
    """Return a list of cameras for error messages, with both names that `find_camera` accepts."""
    names = dict.fromkeys((metadata.camera_name, metadata.camera_id.serialize()) for metadata in cameras)
    texts = [own if own == shared else f"{own} ({shared})" for own, shared in names]
    return ", ".join(texts) or "none"


def read_camera(
    log: Log, frame: int, metadata: PinholeCameraMetadata, image_hw: tuple[int, int], with_image: bool
) -> CameraFrame:
    """Read one camera at one frame, resized to `image_hw`.

    Raises:
        InputError: the image cannot be decoded, or the pose is not finite.
    """
    file = log.file(metadata.modality_key)
    with reading(file, "the camera's poses"):
        T_ego_cam = _extrinsics(log, metadata.modality_key)[frame]
        exposed_us = _exposed_us(log, metadata.modality_key)[frame]
    if np.isnan(T_ego_cam).any():
        raise InputError(f"{file}: the camera pose at frame {frame} is not finite")
    image = None
    if with_image:
        with reading(file, f"the image at frame {frame}"):
            data = log.scene.get_modality_column_at_iteration(
                log.iteration(frame), "data", ModalityType.CAMERA, metadata.camera_id
            )
            if data is not None:
                image = _resize(_open_image(log, frame, metadata, data), image_hw)
    dist = metadata.distortion
    ideal = metadata.is_undistorted or dist is None
    first_s, last_s = _rows_exposed_s(log, metadata.modality_key)
    return CameraFrame(
        image=image,
        K=_scaled_intrinsics(metadata, image_hw),
        T_ego_cam=torch.from_numpy(T_ego_cam).float(),
        dist=torch.zeros(5) if ideal else torch.from_numpy(dist.array.copy()).float(),
        readout_s=last_s - first_s,
        exposed_dt_s=float(exposed_us - log.t_us[frame]) * 1e-6,
    )


def encoded_image(log: Log, frame: int, metadata: PinholeCameraMetadata) -> bytes | None:
    """Return the JPEG or PNG of a camera at one frame in full size. Stored bytes are returned unchanged.

    Raises:
        InputError: the image cannot be read.
    """
    with reading(log.file(metadata.modality_key), f"the image at frame {frame}"):
        data = log.scene.get_modality_column_at_iteration(
            log.iteration(frame), "data", ModalityType.CAMERA, metadata.camera_id
        )
        if data is None or isinstance(data, bytes):
            return data
        out = io.BytesIO()
        _open_image(log, frame, metadata, data).convert("RGB").save(out, "JPEG", quality=95)
        return out.getvalue()


@functools.lru_cache(maxsize=1024)
def _rows_exposed_s(log: Log, modality_key: str) -> tuple[float, float]:
    if log.metadata.dataset in _ROWS_EXPOSED_S:
        return _ROWS_EXPOSED_S[log.metadata.dataset]
    table = get_modality_table(log.path.folder, modality_key)
    if table is None:
        return (0.0, 0.0)
    readout_s = get_metadata_from_arrow_schema(table.schema, RollingCameraMetadata).readout_s
    return (-0.5 * readout_s, 0.5 * readout_s)


@functools.lru_cache(maxsize=64)
def _exposed_us(log: Log, modality_key: str) -> Float64[np.ndarray, "F"]:
    """Return the exposure time of the middle row at every frame, in the log's time.

    Without an image it is the time of the frame.
    """
    exposed_us = log.t_us.astype(np.float64)
    frames, rows = log.rows(modality_key)
    table = get_modality_table(log.path.folder, modality_key)
    if table is not None and len(rows):
        stamp_us = table[f"{modality_key}.timestamp_us"].to_numpy()[rows]
        # The middle row is exposed halfway between the first and the last
        exposed_us[frames] = stamp_us + 0.5e6 * sum(_rows_exposed_s(log, modality_key))
    return exposed_us


@functools.lru_cache(maxsize=64)
def _extrinsics(log: Log, modality_key: str) -> Float64[np.ndarray, "F 4 4"]:
    """Return `T_ego_cam` at every frame.

    It maps from the camera at the exposure of its middle row to the ego frame at the frame's time. It uses
    the logged camera pose if there is one, else the vehicle's pose. Without an image it is the static
    extrinsic matrix.
    """
    metadata = log.scene.get_all_modality_metadatas()[modality_key]
    assert isinstance(metadata, PinholeCameraMetadata)
    mounted = camera_mount(log, metadata)
    T_ego_cam = np.tile(mounted, (len(log), 1, 1))
    frames, rows = log.rows(modality_key)
    table = get_modality_table(log.path.folder, modality_key)
    if table is None or len(rows) == 0:
        return T_ego_cam
    stamp_us = table[f"{modality_key}.timestamp_us"].to_numpy()[rows].astype(np.float64)
    logged = column_array(table, f"{modality_key}.camera_to_global_se3")
    T_world_cam = pose_matrices(fixed_lists(logged, 7)[rows])
    exposed_us = _exposed_us(log, modality_key)[frames]
    T_stamped = _poses_at(log, stamp_us, frames)
    T_exposed = T_stamped if np.array_equal(exposed_us, stamp_us) else _poses_at(log, exposed_us, frames)
    unlogged = logged.is_null().to_numpy(zero_copy_only=False)[rows]
    # Without a logged camera pose: the mounted camera on the vehicle at the time of the image
    T_world_cam[unlogged] = T_stamped[unlogged] @ mounted
    # The camera pose at the image's time, moved with the vehicle from there to the time of exposure
    T_ego_cam[frames] = (
        np.linalg.inv(log.T_world_ego[frames]) @ T_exposed @ np.linalg.inv(T_stamped) @ T_world_cam
    )
    return T_ego_cam


def _poses_at(
    log: Log, t_us: Float64[np.ndarray, "N"], frames: Int64[np.ndarray, "N"]
) -> Float64[np.ndarray, "N 4 4"]:
    """Return the vehicle's poses at some times; those of the frames, without interpolating, if they agree."""
    same = np.array_equal(t_us, log.t_us[frames])
    return log.T_world_ego[frames] if same else log.poses_at(t_us)[0]


def _scaled_intrinsics(metadata: PinholeCameraMetadata, image_hw: tuple[int, int]) -> Float[Tensor, "3 3"]:
    scale = torch.tensor([image_hw[1] / metadata.width, image_hw[0] / metadata.height, 1.0])
    return scale[:, None] * torch.from_numpy(metadata.intrinsics.camera_matrix).float()


def _open_image(
    log: Log, frame: int, metadata: PinholeCameraMetadata, data: bytes | str | int
) -> Image.Image:
    """Open an image as 123D stores it: encoded bytes, a path under the dataset's root, or a video frame."""
    if isinstance(data, bytes):
        try:
            return Image.open(io.BytesIO(data))
        except UnidentifiedImageError as error:
            raise ValueError(f"these {len(data)} bytes are not an image") from error
    if isinstance(data, str):
        root = get_dataset_paths().get_sensor_root(log.metadata.dataset)
        if root is None:
            raise InputError(
                f"{log.file(metadata.modality_key)}: the images lie outside the log; set the environment "
                f"variable of the {log.metadata.dataset} folder, or convert the log with its images in it"
            )
        # The path comes from the log, which may not name files anywhere else
        if PurePath(data).is_absolute() or ".." in PurePath(data).parts:
            raise ValueError(f"the image {data!r} is outside of the data set's folder")
        return Image.open(Path(root) / data)
    camera = log.scene.get_camera_at_iteration(log.iteration(frame), metadata.camera_id)
    return Image.fromarray(camera.image)


def _resize(image: Image.Image, image_hw: tuple[int, int]) -> UInt8[Tensor, "3 H W"]:
    """Resize an image with antialiasing.

    JPEGs are decoded at the smallest scale (1, 1/2, 1/4, 1/8) that is large enough. If the size of a JPEG is
    not a multiple of the scale, the decoded image extends beyond the original by part of a pixel. This part
    is cropped.
    """
    size_wh = image_hw[::-1]
    drafted = image.draft("RGB", size_wh)
    region = drafted[1] if drafted is not None else (0, 0, *image.size)
    resized = image.convert("RGB").resize(size_wh, Image.Resampling.BILINEAR, box=region)
    return torch.from_numpy(np.array(resized).transpose(2, 0, 1).copy())
