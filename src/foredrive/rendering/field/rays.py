"""Rays of cameras and lidars, each with its own pose and time."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.projection import pixels_to_rays
from foredrive.geometry.se3 import exp_se3, rotate_vectors
from foredrive.rendering.views import CameraView, SweepView

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
    uv: Float[Tensor, "R 2"],
    side_px: float = 1.0,
    offset: Float[Tensor, "6"] | None = None,
    twist: Float[Tensor, "6"] | None = None,
    late_s: Float[Tensor, ""] | None = None,
) -> FieldRays:
    """Return rays through positions of an image, where the camera is when their rows are exposed.

    The camera moves and turns at constant rates while the image is read out, row by row.

    Args:
        view: the camera.
        uv: pixel coordinates.
        side_px: side of the square of pixels that a ray stands for.
        offset: correction of the camera's pose, in its own axes: m, rad.
        twist: correction of its velocity and turn rate.
        late_s: delay of the exposure with respect to `view.t_s`.
    """
    dt_s = (uv[:, 1] / view.size_hw[0] - 0.5) * view.readout_s
    if late_s is not None:
        dt_s = dt_s + late_s
    twist = view.twist_cam if twist is None else view.twist_cam + twist
    T_scene_cam = view.T_scene_cam if offset is None else view.T_scene_cam @ exp_se3(offset)
    T = T_scene_cam @ exp_se3(dt_s[:, None] * twist)
    direction = pixels_to_rays(uv, view.K, view.dist)
    focal = view.K[0, 0] * view.K[1, 1]
    # Away from the axis, pixels are seen smaller: by the cosine of the angle, cubed.
    area = side_px**2 / focal * direction[:, 2].abs() ** 3
    direction = (T[:, :3, :3] @ direction[..., None])[..., 0]
    return FieldRays(T[:, :3, 3], direction, view.t_s + dt_s, area)


def beam_rays(view: SweepView) -> FieldRays:
    """Return the beams of a sweep; each has its own origin and time, and the divergence of a beam."""
    beams = view.beams
    origin = rotate_vectors(view.T_scene_ego, beams.origin_ego) + view.T_scene_ego[:3, 3]
    direction = rotate_vectors(view.T_scene_ego, beams.dir_ego)
    wide, high = BEAM_DIVERGENCE_RAD
    area = torch.full_like(beams.dt_s, wide * high)
    return FieldRays(origin, direction, view.t_s + beams.dt_s, area)
