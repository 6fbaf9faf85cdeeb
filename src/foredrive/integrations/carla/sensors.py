"""Conversions of Foredrive's sensors to CARLA's, and of CARLA's sensor data to tensors."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int, UInt8
from torch import Tensor

from foredrive.driving.dynamics import STEP_S
from foredrive.errors import InputError
from foredrive.integrations.carla.frames import CarlaPose, camera_pose, mirrored, pose_of
from foredrive.scene import CameraRig, LidarSweep
from foredrive.sensors import SpinningLidar

CAMERA, LIDAR = "sensor.camera.rgb", "sensor.lidar.ray_cast"
PIXEL_TOLERANCE = 0.01


def camera_specs(rig: CameraRig, T_actor_ego: Float64[np.ndarray, "4 4"]) -> list[dict[str, Any]]:
    """Return a rig's camera specs as in the leaderboard's `sensors()`: m and degrees on CARLA's actor.

    Args:
        rig: rig without leading dimensions.

    Raises:
        InputError: CARLA has no such camera. Its cameras are pinholes with square pixels, a centred principal
            point and a global shutter.
    """
    height, width = rig.size_hw
    specs = []
    for i, name in enumerate(rig.names):
        fx, fy, cx, cy = (float(rig.K[i][index]) for index in ((0, 0), (1, 1), (0, 2), (1, 2)))
        wrong = max(abs(fy - fx), abs(cx - 0.5 * width), abs(cy - 0.5 * height))
        if wrong > PIXEL_TOLERANCE or bool(rig.dist[i].any()) or float(rig.readout_s[i]) > 0:
            raise InputError(
                f"camera {name}: CARLA's have square pixels, a centred principal point, no distortion and a "
                f"global shutter; this one has fx {fx:.2f}, fy {fy:.2f}, cx {cx:.2f} of {width}, cy {cy:.2f} "
                f"of {height}, dist {rig.dist[i].tolist()}, readout {float(rig.readout_s[i])} s"
            )
        fov_deg = math.degrees(2 * math.atan(0.5 * width / fx))
        pose = camera_pose(rig.T_ego_cam[i].double().numpy(), T_actor_ego)
        what = {"type": CAMERA, "id": name, "width": width, "height": height, "fov": fov_deg}
        specs.append(what | mounting(pose))
    return specs


def camera_attributes(spec: dict[str, Any]) -> dict[str, str]:
    """Return the attributes of a camera's blueprint, without lens effects.

    Cameras render at every step, but only key frames use the images. `sensor_tick` would avoid this, but it
    counts in floating point and may miss the frame that is waited for.
    """
    return {
        "image_size_x": str(spec["width"]),
        "image_size_y": str(spec["height"]),
        "fov": repr(float(spec["fov"])),
        "lens_k": "0.0",
        "lens_kcube": "0.0",
        "lens_circle_falloff": "0.0",
        "sensor_tick": "0.0",
    }


def lidar_attributes(lidar: SpinningLidar) -> dict[str, str]:
    """Return the attributes of a lidar's blueprint: one revolution per simulation step, no random dropout.

    CARLA's channels are spaced evenly between the highest and the lowest. All beams of a step are sent at one
    time.
    """
    channels = len(lidar.elevation_rad)
    return {
        "channels": str(channels),
        "range": repr(lidar.max_range_m),
        "points_per_second": str(round(channels * lidar.azimuth_steps / STEP_S)),
        "rotation_frequency": repr(1 / STEP_S),
        "upper_fov": repr(round(math.degrees(max(lidar.elevation_rad)), 4)),
        "lower_fov": repr(round(math.degrees(min(lidar.elevation_rad)), 4)),
        "dropoff_general_rate": "0.0",
        "dropoff_intensity_limit": "1.0",
        "dropoff_zero_intensity": "0.0",
        "noise_stddev": repr(lidar.range_noise_m),
        "sensor_tick": "0.0",
    }


def lidar_pose(lidar: SpinningLidar, T_actor_ego: Float64[np.ndarray, "4 4"]) -> CarlaPose:
    """Return the mounting pose of a lidar on CARLA's actor."""
    return pose_of(T_actor_ego @ lidar.T_ego_lidar.double().numpy())


def lidar_spec(lidar: SpinningLidar, name: str, T_actor_ego: Float64[np.ndarray, "4 4"]) -> dict[str, Any]:
    """Return a lidar in the form of the leaderboard's `sensors()`, which has only one kind of lidar."""
    return {"type": LIDAR, "id": name} | mounting(lidar_pose(lidar, T_actor_ego))


def mounting(pose: CarlaPose) -> dict[str, float]:
    """Return a pose with the leaderboard's field names."""
    x, y, z, roll, pitch, yaw = pose
    return {"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw}


def image_of(bgra: UInt8[np.ndarray, "H W 4"]) -> UInt8[Tensor, "3 H W"]:
    """Convert an image of CARLA's cameras to RGB. Its channels are B, G, R and an unused alpha."""
    return torch.from_numpy(np.ascontiguousarray(bgra[..., 2::-1].transpose(2, 0, 1)))


def bgra_of(image: Any) -> UInt8[np.ndarray, "H W 4"]:
    """Return the pixels of a `carla.Image`."""
    return np.frombuffer(image.raw_data, dtype=np.uint8).reshape(image.height, image.width, 4)


def sweep_of(
    points: Float32[np.ndarray, "N 4"], counts: Int[np.ndarray, "C"], lidar: SpinningLidar
) -> LidarSweep:
    """Convert the lidar data of one step. It has returns only: CARLA does not report beams that hit nothing.

    Args:
        points: x, y, z, intensity in the lidar's left-handed axes, channel by channel, highest first.
        counts: number of returns of each channel.
    """
    T = lidar.T_ego_lidar.double().numpy()
    along = mirrored(points[:, :3].astype(np.float64))
    range_m = np.linalg.norm(along, axis=1)
    direction = along / np.maximum(range_m, 1e-6)[:, None] @ T[:3, :3].T
    valid = (range_m >= lidar.min_range_m).tolist()
    return LidarSweep(
        origin_ego=torch.from_numpy(np.tile(T[:3, 3], (len(points), 1))).float(),
        dir_ego=torch.from_numpy(direction).float(),
        range_m=torch.from_numpy(range_m).float(),
        returned=torch.tensor(valid, dtype=torch.bool),
        intensity=torch.from_numpy(points[:, 3].copy()),
        dt_s=torch.zeros(len(points)),
        beam=torch.from_numpy(np.repeat(np.arange(len(counts)), counts)),
        valid=torch.tensor(valid, dtype=torch.bool),
    )
