"""Poses of the sensors of a bag on the vehicle, at the time of each message."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from foredrive.data.formats.bag_messages import cloud_pose, frame_of
from foredrive.data.formats.bag_topics import CameraTopics, LidarTopic, Mount
from foredrive.data.formats.frame_tree import FrameTree
from foredrive.data.notices import note

USUAL_POSITION_M = (0.0, 0.0, 1.8)
"""Position of a lidar on a roof, ego frame, m."""
_T_BODY_OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
"""Transform from a camera's optical axes (x right, y down, z ahead) to its body's (x ahead, y left, z up)."""
_UPRIGHT = 0.8
"""A frame is upright if its axis z has this share of the vehicle's, which is within 37 degrees."""


@dataclass(frozen=True)
class Mounts:
    """Poses of sensors on the vehicle at the times of their messages."""

    tree: FrameTree
    ego_frame: str
    T_ego_origin: Float64[np.ndarray, "4 4"]
    """Transform from the log's ego frame to that of the bag."""

    def at(self, sensor: str, t_us: Int64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 4 4"]:
        """Return T_ego_sensor at times."""
        # One look-up is enough for a sensor that is fixed to the vehicle
        moves = self.tree.moves(self.ego_frame, sensor)
        T = self.tree.between(self.ego_frame, sensor, t_us if moves else t_us[:1])
        return np.linalg.inv(self.T_ego_origin) @ np.broadcast_to(T, (len(t_us), 4, 4))

    def given(self, mount: Mount) -> Float64[np.ndarray, "4 4"]:
        """Return T_ego_sensor by a mount of the YAML."""
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(mount.quaternion_wxyz, scalar_first=True).as_matrix()
        T[:3, 3] = mount.position_m
        return np.asarray(np.linalg.inv(self.T_ego_origin) @ T)

    def of_camera(
        self, camera: CameraTopics, first: Any, t_us: Int64[np.ndarray, "N"]
    ) -> Float64[np.ndarray, "N 4 4"]:
        """Return T_ego_cam at the times of images, given the first of them.

        Many drivers name the camera's body, with x ahead and z up, and have no optical frame. A camera whose
        axis z points up would look at the zenith, so the rotation from body to optical axes is added.
        """
        if camera.mount is not None:
            return np.tile(self.given(camera.mount), (len(t_us), 1, 1))
        frame = camera.frame or frame_of(first)
        T = self.at(frame, t_us)
        if T[0, 2, 2] > _UPRIGHT and "optical" not in frame.lower():
            T = T @ _T_BODY_OPTICAL
            text = f"its frame {frame} has z up, as no optical frame has"
            note(
                camera.images, f"{text}; it was taken for one with x ahead (set `frame` or `mount` otherwise)"
            )
        return T

    def of_cloud(self, lidar: LidarTopic, message: Any, t_us: int) -> Float64[np.ndarray, "4 4"]:
        """Return the transform to the ego frame of the points of one message."""
        if lidar.mount is not None:
            return self.given(lidar.mount)
        return self.at(lidar.frame or frame_of(message), np.array([t_us]))[0]

    def is_registered(self, lidar: LidarTopic, message: Any) -> bool:
        """Return whether the frame of a cloud is no part of the vehicle: its points stay in the world."""
        frame = lidar.frame or frame_of(message)
        on_board = frame == self.ego_frame or self.tree.is_below(frame, self.ego_frame)
        return lidar.mount is None and not on_board and self.tree.moves(self.ego_frame, frame)

    def position_m(self, lidar: LidarTopic, first: Any, t_us: int) -> tuple[float, float, float]:
        """Return the place where the beams of a lidar begin, ego frame, m.

        A cloud in the world has lost it: it is then `USUAL_POSITION_M`.
        """
        if self.is_registered(lidar, first):
            text = f"its frame {lidar.frame or frame_of(first)} does not move with {self.ego_frame}"
            note(
                lidar.topic,
                f"{text}; each sweep was placed by the pose at its time, beams begin 1.8 m above the axle",
            )
            return USUAL_POSITION_M
        if lidar.mount is None and self.tree.moves(self.ego_frame, lidar.frame or frame_of(first)):
            note(lidar.topic, "the lidar moves on the vehicle; each sweep has the mount of its time")
        T = self.of_cloud(lidar, first, t_us) @ cloud_pose(first)
        return tuple(T[:3, 3].tolist())
