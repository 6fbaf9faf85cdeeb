"""Rays of cameras and lidars, each with its own pose and time."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.projection import pixels_to_rays
from foredrive.geometry.se3 import exp_se3, rotate_vectors, transform_points
from foredrive.methods.reconstruction.reconstructed import SensorMotion
from foredrive.methods.reconstruction.views import CameraView, SweepView

BEAM_DIVERGENCE_RAD = (3.0e-3, 1.5e-3)
"""Horizontal and vertical divergence of a lidar's beam, as in NeuRAD's reference implementation."""


class FieldRays(NamedTuple):
    """R rays in the scene's frame."""

    origin: Float[Tensor, "R 3"]
    direction: Float[Tensor, "R 3"]
    """Unit vectors."""
    t_s: Float[Tensor, "R"]
    """Time of each ray, s since the start of the drive."""
    area: Float[Tensor, "R"]
    """Cross-section of the ray's cone at a distance of 1 m, m²."""


def pixel_rays(
    view: CameraView,
    exposed: SensorMotion,
    uv: Float[Tensor, "R 2"],
    side_px: float = 1.0,
    rolling: bool = True,
) -> FieldRays:
    """Return rays through positions of an image, where the camera is when their rows are exposed.

    The camera moves and turns at constant rates while the image is read out, row by row.

    Args:
        view: the camera.
        exposed: its pose, motion and time when the middle row is exposed.
        uv: pixel coordinates.
        side_px: side of the square of pixels that a ray stands for.
        rolling: if False, all rows are exposed with the middle row.
    """
    # Time of each row relative to the middle row
    dt_s = (uv[:, 1] / view.size_hw[0] - 0.5) * (view.readout_s if rolling else 0.0)
    # Pose of the camera when the row is exposed
    T = exposed.T_scene_cam @ exp_se3(dt_s[:, None] * exposed.twist_cam)
    direction = pixels_to_rays(uv, view.K, view.dist)
    focal = view.K[0, 0] * view.K[1, 1]
    # Away from the axis, pixels are seen smaller: by the cosine of the angle, cubed.
    area = side_px**2 / focal * direction[:, 2].abs() ** 3
    direction = (T[:, :3, :3] @ direction[..., None])[..., 0]
    return FieldRays(T[:, :3, 3], direction, exposed.t_s + dt_s, area)


def beam_rays(view: SweepView, rolling: bool = True) -> FieldRays:
    """Return the beams of a sweep with the divergence of a beam; each has its own origin.

    Args:
        view: the sweep.
        rolling: each beam has its own time. If False, all have that of the sweep.
    """
    beams = view.beams
    # Origins are those of the moving sensor, at the time of each beam
    origin = transform_points(view.T_scene_ego, beams.origin_ego)
    direction = rotate_vectors(view.T_scene_ego, beams.dir_ego)
    wide, high = BEAM_DIVERGENCE_RAD
    area = torch.full_like(beams.dt_s, wide * high)
    dt_s = beams.dt_s if rolling else torch.zeros_like(beams.dt_s)
    return FieldRays(origin, direction, view.t_s + dt_s, area)
