"""Decoding of images from other sources: 8-bit RGB, or an error that names the problem."""

import io
from pathlib import Path

import numpy as np
from jaxtyping import Shaped, UInt8
from PIL import Image, UnidentifiedImageError

from foredrive.errors import InputError

_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_DEEP_MODES = ("I;16", "I;16B", "I;16L", "I;16N", "I", "F")
"""Pillow's modes of grey images with more than 8 bits. Its conversion to RGB would clip them to white."""


def is_image(file: Path) -> bool:
    """Return whether a file has the name of an image. File browsers leave hidden files next to images."""
    return file.suffix.lower() in _SUFFIXES and not file.name.startswith(".")


def decoded(image: Path | str | bytes) -> Shaped[np.ndarray, "H W *channels"]:
    """Return an image as uint8 RGB [H, W, 3], or as grey [H, W] if it is grey with more than 8 bits.

    Raises:
        InputError: it cannot be decoded.
    """
    name = "" if isinstance(image, bytes) else f"{image}: "
    try:
        with Image.open(io.BytesIO(image) if isinstance(image, bytes) else image) as opened:
            return np.asarray(opened if opened.mode in _DEEP_MODES else opened.convert("RGB"))
    except UnidentifiedImageError as error:  # its text has the address of an object
        raise InputError(f"{name}cannot read the image: its format is not known") from error
    except (OSError, Image.DecompressionBombError, SyntaxError, ValueError) as error:
        raise InputError(f"{name}cannot read the image: {error}") from error


def read_rgb(
    image: Path | str | bytes, value_range: tuple[float, float] | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Return an image file, or its bytes, as RGB.

    Args:
        image: path of the file, or its content.
        value_range: values of a grey image with more than 8 bits that become 0 and 255.

    Raises:
        InputError: it cannot be decoded, or has more than 8 bits and no range is given.
    """
    pixels = decoded(image)
    if pixels.ndim == 3:
        return pixels
    if value_range is None:
        low, high = pixels.min(), pixels.max()
        name = "an image" if isinstance(image, bytes) else image
        raise InputError(f"{name}: it has more than 8 bits ({low} to {high}); scale it to 8 bits")
    return grey_to_rgb(pixels, value_range)


def whole_jpeg(image: Path | str | bytes) -> bytes | None:
    """Return the bytes of an RGB image in JPEG that is not cut off, or None for other images.

    Decoding it at an eighth of its size is fast and finds those that are cut.

    Raises:
        InputError: it cannot be decoded.
    """
    name = "" if isinstance(image, bytes) else f"{image}: "
    try:
        data = image if isinstance(image, bytes) else Path(image).read_bytes()
        with Image.open(io.BytesIO(data)) as opened:
            if (opened.format, opened.mode) != ("JPEG", "RGB"):
                return None
            opened.draft("RGB", (opened.width // 8, opened.height // 8))
            opened.load()
        return data
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError, SyntaxError, ValueError) as error:
        raise InputError(f"{name}cannot read the image: {error}") from error


def image_size(image: bytes) -> tuple[int, int]:
    """Return height and width of an encoded image, px."""
    with Image.open(io.BytesIO(image)) as opened:
        return opened.height, opened.width


def grey_to_rgb(
    pixels: Shaped[np.ndarray, "H W"], value_range: tuple[float, float]
) -> UInt8[np.ndarray, "H W 3"]:
    """Return a grey image as RGB, with the ends of `value_range` at 0 and 255."""
    low, high = value_range
    share = (pixels.astype(np.float64) - low) / max(high - low, 1e-12)
    grey = np.round(255 * share.clip(0, 1)).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def check_size(image: UInt8[np.ndarray, "H W 3"], size_hw: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """Return an image, which must have the size of its camera's calibration.

    Raises:
        InputError: it has another one.
    """
    if image.shape[:2] != size_hw:
        (height, width), (rows, columns) = size_hw, image.shape[:2]
        calibrated = f"the calibration is of {width} x {height} px"
        raise InputError(f"an image of {columns} x {rows} px; {calibrated}")
    return image
