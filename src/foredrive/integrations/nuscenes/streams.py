"""Sensor files of a log in nuScenes' format: images without distortion, and sweeps of LIDAR_TOP."""

import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Int64
from PIL import Image
from scipy.spatial.transform import Rotation

from foredrive.data.arrow_files import reading
from foredrive.data.cameras import CameraFrame, camera_mount, encoded_image, pinhole_cameras, read_camera
from foredrive.data.formats.nuscenes_names import camera_channel
from foredrive.data.lidar import frames_with_lidar, main_lidar_mount
from foredrive.data.logs import Log
from foredrive.integrations.nuscenes.tables import Row, pose, token
from foredrive.scene import LidarSweep

LIDAR = "LIDAR_TOP"
JPEG_QUALITY = 95
_NUSCENES_LIDAR_AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation from nuScenes' lidar (x to the right, y ahead) to the ego frame, but for its mounting."""


@dataclass(frozen=True)
class Stream:
    """One sensor with its calibration, and the readings of it that are written."""

    channel: str
    T_ego_sensor: Float64[np.ndarray, "4 4"]
    present: Int64[np.ndarray, "_"]
    """Frames with data of it."""
    t_us: Int64[np.ndarray, "F"]
    """Time of the reading at each frame."""
    encode: Callable[[int, LidarSweep | None], bytes | None]
    """Returns the content of the file at a frame, whose sweep is given."""
    T_world_ego: Callable[[int], Float64[np.ndarray, "4 4"]]
    """Returns the pose of the vehicle at the time of the reading at a frame."""
    intrinsic: list[list[float]]
    size_hw: tuple[int, int] = (0, 0)

    @property
    def is_camera(self) -> bool:
        """Return whether it is no lidar."""
        return self.channel != LIDAR

    @property
    def ending(self) -> str:
        """Return how the names of its files end."""
        return "jpg" if self.is_camera else "pcd.bin"

    def written(self, key_frames: Int64[np.ndarray, "K"], *, sweeps: bool) -> list[int]:
        """Return the frames whose readings are written, in order: each reading once, at its key frame if any.

        Frames may share an image where a camera is slower than the log. Key frames that share one have it
        both.
        """
        key, chosen = set(key_frames.tolist()), dict[int, list[int]]()
        for frame in self.present.tolist():
            same = chosen.setdefault(int(self.t_us[frame]), [])
            if frame in key:
                same[:] = [*(other for other in same if other in key), frame]
            elif sweeps and not same:
                same.append(frame)
        return sorted(frame for frames in chosen.values() for frame in frames)

    def sensor_rows(self, log_name: str) -> tuple[Row, Row]:
        """Return the rows of the tables `sensor` and `calibrated_sensor`."""
        modality = "camera" if self.is_camera else "lidar"
        sensor = {"token": token("sensor", self.channel), "channel": self.channel, "modality": modality}
        calibrated = {
            "token": token("calibrated_sensor", log_name, self.channel),
            "sensor_token": sensor["token"],
            **pose(self.T_ego_sensor),
            "camera_intrinsic": self.intrinsic,
        }
        return sensor, calibrated


def streams_of(log: Log) -> list[Stream]:
    """Return the cameras and the lidar of a log. A sensor without any reading is left out."""
    streams = []
    for camera in pinhole_cameras(log).values():
        frames, _ = log.rows(camera.modality_key)
        if len(frames):
            streams.append(_camera_stream(log, camera, frames))
    mounted, frames = main_lidar_mount(log), frames_with_lidar(log)
    if mounted is not None and len(frames):
        streams.append(_lidar_stream(log, mounted, frames))
    return streams


def lidar_axes(T_ego_lidar: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """Return a lidar's pose with its axes renamed: x most to the right, y most ahead, z most up.

    Only right angles are turned, so tilt and yaw of the mounting stay.
    """
    turns = Rotation.create_group("O").as_matrix()
    agreement = np.einsum("ij,ik,nkj->n", _NUSCENES_LIDAR_AXES, T_ego_lidar[:3, :3], turns)
    renamed = T_ego_lidar.copy()
    renamed[:3, :3] = T_ego_lidar[:3, :3] @ turns[agreement.argmax()].round()
    return renamed


def _camera_stream(log: Log, camera: Any, frames: Int64[np.ndarray, "_"]) -> Stream:
    """Return the stream of a camera by 123D's metadata, which only `data` imports."""
    mounted, size_hw = camera_mount(log, camera), (camera.height, camera.width)

    def read(frame: int) -> CameraFrame:
        return read_camera(log, frame, camera, size_hw, with_image=False)

    def encode(frame: int, _: LidarSweep | None) -> bytes | None:
        data = encoded_image(log, frame, camera)
        if data is None:
            return None
        with reading(log.file(camera.modality_key), f"the image at frame {frame}"):
            return _as_jpeg(data, size_hw, read(frame))

    def T_world_ego(frame: int) -> np.ndarray:
        T_ego_cam = read(frame).T_ego_cam.double().numpy()
        T: np.ndarray = log.T_world_ego[frame] @ T_ego_cam @ np.linalg.inv(mounted)
        return T

    t_us = log.t_us.copy()
    for frame in frames.tolist():
        t_us[frame] += round(read(frame).exposed_dt_s * 1e6)
    K = camera.intrinsics.camera_matrix.tolist()
    return Stream(camera_channel(camera), mounted, frames, t_us, encode, T_world_ego, K, size_hw)


def _as_jpeg(data: bytes, size_hw: tuple[int, int], camera: CameraFrame) -> bytes:
    """Return an image as a JPEG of a pinhole without distortion, unchanged if it is one.

    Without distortion, the image has the same intrinsics. What the camera has not seen is black.
    """
    with Image.open(io.BytesIO(data)) as image:
        ideal = not bool(camera.dist.any())
        if ideal and (image.format, image.mode, image.size) == ("JPEG", "RGB", size_hw[::-1]):
            return data
        rgb = image.convert("RGB")
    if rgb.size != size_hw[::-1]:
        rgb = rgb.resize(size_hw[::-1], Image.Resampling.BILINEAR)
    if not ideal:
        K = camera.K.double().numpy().copy()
        K[:2, 2] -= 0.5  # OpenCV's pixel centres are whole numbers
        rgb = Image.fromarray(cv2.undistort(np.asarray(rgb), K, camera.dist.double().numpy()))
    out = io.BytesIO()
    rgb.save(out, "JPEG", quality=JPEG_QUALITY)
    return out.getvalue()


def _lidar_stream(log: Log, mounted: np.ndarray, frames: Int64[np.ndarray, "_"]) -> Stream:
    T_ego_lidar = lidar_axes(mounted)

    def encode(_: int, sweep: LidarSweep | None) -> bytes | None:
        return None if sweep is None else _as_points(sweep, T_ego_lidar)

    return Stream(LIDAR, T_ego_lidar, frames, log.t_us, encode, lambda frame: log.T_world_ego[frame], [])


def _as_points(sweep: LidarSweep, T_ego_lidar: Float64[np.ndarray, "4 4"]) -> bytes:
    """Return the returns of a sweep as nuScenes' points: x y z in the lidar's frame, intensity, ring.

    Intensity is 0 to 255. The ring is the channel of the beam, 0 where the log has none.
    """
    sweep = sweep[sweep.valid & sweep.returned]
    points = (sweep.points_ego.double().numpy() - T_ego_lidar[:3, 3]) @ T_ego_lidar[:3, :3]
    intensity = (255.0 * sweep.intensity).round().numpy()
    ring = sweep.beam.clamp(min=0).numpy()
    return np.column_stack([points, intensity, ring]).astype("<f4").tobytes()
