"""Rays to render from a clip, and their true colours."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.geometry.projection import pixel_centres, pixels_to_rays
from foredrive.geometry.se3 import rotate_vectors
from foredrive.scene import Clip


class ImageRays(NamedTuple):
    """One ray per pixel of C images thinned to h×w, in the ego frame of one key frame."""

    origin: Float[Tensor, "b R 3"]
    """R = C·h·w, cameras first."""
    direction: Float[Tensor, "b R 3"]
    rgb: Float[Tensor, "b C 3 h w"]
    """0 to 1."""
    valid: Bool[Tensor, "b C"]


def thinned_rays(clip: Clip, frame: int, stride: int, generator: torch.Generator | None = None) -> ImageRays:
    """Return the rays of every stride-th pixel of all cameras of one frame.

    The thinned pixels form a small image, so losses on images (also perceptual ones) apply. The phase of the
    grid is random with a generator and central without.

    Args:
        clip: images [b T C 3 H W].
        frame: index into T.
        stride: keep one pixel in `stride` along rows and columns.
    """
    # A central phase makes evaluation deterministic
    if generator is None:
        row, column = stride // 2, stride // 2
    else:
        row, column = torch.randint(stride, (2,), generator=generator).tolist()
    images = clip.images[:, frame, :, :, row::stride, column::stride]
    return _rays(clip, frame, pixel_centres(clip.rig.size_hw)[row::stride, column::stride], images.float())


def averaged_rays(clip: Clip, frame: int, stride: int, generator: torch.Generator) -> ImageRays:
    """Return the rays through the centres of stride × stride blocks of pixels, and the mean colours of these.

    The blocks start at a random phase; those that the border of the image cuts are left out. In contrast to
    thinned pixels, they form a small image without aliasing.

    Args:
        clip: images [b T C 3 H W].
        frame: index into T.
        stride: size of a block, pixels.
    """
    row, column = torch.randint(stride, (2,), generator=generator).tolist()
    images = clip.images[:, frame, :, :, row:, column:].float()
    means = F.avg_pool2d(images.flatten(0, 1), stride).unflatten(0, images.shape[:2])
    # Centre of block (i, j) is stride · (j + 0.5, i + 0.5) from the start of the grid
    centres = stride * pixel_centres((means.shape[-2], means.shape[-1]))
    return _rays(clip, frame, centres + torch.tensor([float(column), float(row)]), means)


def _rays(
    clip: Clip, frame: int, uv: Float[Tensor, "h w 2"], rgb_255: Float[Tensor, "b C 3 h w"]
) -> ImageRays:
    """Return the rays through places uv of every image of a frame."""
    b, c = rgb_255.shape[:2]
    K, dist = clip.rig.K[:, frame], clip.rig.dist[:, frame]
    T_ego_cam = clip.rig.T_ego_cam[:, frame]
    uv = uv.reshape(-1, 2).to(rgb_255.device)
    direction = rotate_vectors(T_ego_cam, pixels_to_rays(uv.expand(b, c, -1, 2), K, dist))
    origin = T_ego_cam[..., None, :3, 3].expand_as(direction)
    return ImageRays(
        origin=origin.flatten(1, 2),
        direction=direction.flatten(1, 2),
        rgb=rgb_255 / 255,
        valid=clip.image_valid[:, frame],
    )
