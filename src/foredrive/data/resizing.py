"""Resizing of the images of a clip, in the same way as datasets read them from logs."""

import dataclasses

import numpy as np
import torch
from PIL import Image

from foredrive.scene import Clip


def shrink_images(clip: Clip, image_hw: tuple[int, int]) -> Clip:
    """Return the clip with resized images and matching intrinsics, antialiased as in `read_camera`."""
    height, width = clip.rig.size_hw
    if (height, width) == image_hw:
        return clip
    flat = clip.images.reshape(-1, 3, height, width).permute(0, 2, 3, 1).contiguous().numpy()
    shrunk = [
        np.array(Image.fromarray(image).resize(image_hw[::-1], Image.Resampling.BILINEAR)) for image in flat
    ]
    images = torch.from_numpy(np.stack(shrunk).transpose(0, 3, 1, 2).copy())
    scale = torch.tensor([image_hw[1] / width, image_hw[0] / height, 1.0])
    rig = dataclasses.replace(clip.rig, K=scale[:, None] * clip.rig.K, size_hw=image_hw)
    return dataclasses.replace(clip, images=images.reshape(*clip.images.shape[:-2], *image_hw), rig=rig)
