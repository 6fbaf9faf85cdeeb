"""Timed rays of camera pixels."""

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.projection import pixel_centres, pixels_to_rays
from foredrive.geometry.se3 import rotate_vectors
from foredrive.scene import CameraRig
from foredrive.sensors.rays import TimedRays


def camera_rays(rig: CameraRig, samples_per_pixel: int = 1) -> TimedRays:
    """Return the rays of all pixels of every camera.

    Args:
        rig: cameras with leading dimensions *b.
        samples_per_pixel: 1, or a square number n² for n×n evenly spaced points in each pixel.

    Returns:
        Rays [*b C N] with N = H·W·samples, in row order. The samples of a pixel are adjacent. The time is
        relative to the exposure of the middle image row. The ego frame is the destination frame of
        `T_ego_cam`.
    """
    # Sub-positions in each pixel, and viewing directions rotated to the ego frame
    offsets = _subpixel_offsets(samples_per_pixel).to(rig.K)
    uv = (pixel_centres(rig.size_hw).to(rig.K)[:, :, None] + offsets).reshape(-1, 2)  # [H·W·samples, 2]
    batch = rig.K.shape[:-2]
    direction = rotate_vectors(rig.T_ego_cam, pixels_to_rays(uv.expand(*batch, -1, 2), rig.K, rig.dist))
    return TimedRays(
        # All rays of a camera start at its optical centre
        origin_ego=rig.T_ego_cam[..., None, :3, 3].expand_as(direction),
        dir_ego=direction,
        dt_s=readout_time_s(uv[:, 1], rig),
    )


def readout_time_s(v_px: Float[Tensor, "N"], rig: CameraRig) -> Float[Tensor, "*b C N"]:
    """Return the time at which a rolling shutter reads row v (px), relative to the middle row, s."""
    return (v_px / rig.size_hw[0] - 0.5) * rig.readout_s[..., None]


def _subpixel_offsets(samples_per_pixel: int) -> Float[Tensor, "S 2"]:
    side = round(samples_per_pixel**0.5)
    if side * side != samples_per_pixel:
        raise ValueError(f"samples_per_pixel must be a square number, got {samples_per_pixel}")
    steps = (torch.arange(side) + 0.5) / side - 0.5
    v, u = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack([u, v], dim=-1).reshape(-1, 2)
