"""Images of a colour filter's mosaic that were read as grey ones."""

import io

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError
from py123d.datatypes import PinholeCameraMetadata

from foredrive.data.cameras import encoded_image
from foredrive.data.logs import Log

MAX_RATIO = 0.85
"""In a mosaic, pixels two apart have one filter and differ by less than neighbours, by this share at most. In
images they differ by 1.7 times as much, in noise by as much."""
MIN_DIFFERENCE = 1.0
"""Mean difference of neighbours (of 255) below which an image is too flat to tell."""


def is_mosaic(log: Log, frame: int, camera: PinholeCameraMetadata) -> bool:
    """Return whether the image of a camera at a frame is grey with the pattern of a colour filter.

    Raises:
        InputError: the image cannot be read.
    """
    encoded = encoded_image(log, frame, camera)
    if encoded is None:
        return False
    try:
        pixels = np.asarray(Image.open(io.BytesIO(encoded)).convert("RGB"))
    except (OSError, ValueError, UnidentifiedImageError):
        return False  # the check of the images reports it
    return has_pattern(pixels)


def has_pattern(pixels: UInt8[np.ndarray, "H W 3"]) -> bool:
    """Return whether an image is grey, with neighbours that differ more than pixels two apart."""
    if min(pixels.shape[:2]) < 3 or (pixels != pixels[..., :1]).any():
        return False
    grey = pixels[..., 0].astype(np.int16)
    for along in (grey, grey.T):
        one, two = (float(np.abs(along[k:] - along[:-k]).mean()) for k in (1, 2))
        if one < MIN_DIFFERENCE or two > MAX_RATIO * one:
            return False
    return True
