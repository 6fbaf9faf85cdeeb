"""Sectors of a scene: the field of view of a camera, or one of four directions in logs without cameras."""

import dataclasses
import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.data.cameras import CameraFrame
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw, rotate_vectors, transform_points
from foredrive.scene import LidarSweep

BLIND_SECTORS = {"ahead": 0.0, "left": 90.0, "behind": 180.0, "right": -90.0}
"""Sectors of logs without cameras: azimuth of their middle, degrees counter-clockwise from ahead."""
_HALF_RAD = math.pi / 4


class Sector(NamedTuple):
    """A sector of a scene around a direction."""

    azimuth_rad: float
    """Azimuth of its middle in the ego frame, counter-clockwise from ahead."""
    camera: CameraFrame | None = None
    """Camera whose image bounds the sector. None means 45 degrees on both sides of the middle."""
    size_hw: tuple[int, int] = (0, 0)
    """Height and width of the camera's images, px."""

    @classmethod
    def of_camera(cls, camera: CameraFrame, size_hw: tuple[int, int]) -> "Sector":
        """Return the sector of a camera whose images have this size."""
        # The camera's z axis in the ego frame
        forward = camera.T_ego_cam[:2, 2]
        return cls(float(torch.atan2(forward[1], forward[0])), camera, size_hw)

    def contains(self, points_ego: Float[Tensor, "N 3"]) -> Bool[Tensor, "N"]:
        """Return whether points are in the sector."""
        if self.camera is None:
            off_rad = torch.atan2(points_ego[:, 1], points_ego[:, 0]) - self.azimuth_rad
            # Wrap the difference of angles to ±π
            return torch.atan2(off_rad.sin(), off_rad.cos()).abs() <= _HALF_RAD
        points_cam = transform_points(inverse_se3(self.camera.T_ego_cam), points_ego)
        return project(points_cam, self.camera.K, self.camera.dist, self.size_hw)[2]

    def sweep(self, sweep: LidarSweep) -> LidarSweep:
        """Return an unbatched sweep's returns in the sector, with x along its middle (see `Towers`)."""
        inside = sweep[sweep.valid & sweep.returned & self.contains(sweep.points_ego)]
        # Turned about the ego origin, not moved to the camera
        T_sector_ego = matrix_from_yaw(torch.tensor(-self.azimuth_rad), torch.zeros(3))
        return dataclasses.replace(
            inside,
            origin_ego=rotate_vectors(T_sector_ego, inside.origin_ego),
            dir_ego=rotate_vectors(T_sector_ego, inside.dir_ego),
        )


def cut_camera(camera: CameraFrame, box_px: tuple[int, int, int, int]) -> CameraFrame:
    """Return a camera with a part of its image (left, top, right, bottom) and its principal point moved."""
    left, top, right, bottom = box_px
    shift = torch.tensor([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
    image = None if camera.image is None else camera.image[:, top:bottom, left:right]
    return dataclasses.replace(camera, image=image, K=camera.K - shift)


def blind_sectors() -> dict[str, Sector]:
    """Return four sectors around a vehicle without cameras."""
    return {name: Sector(math.radians(deg)) for name, deg in BLIND_SECTORS.items()}
