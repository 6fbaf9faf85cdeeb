"""Images of ROS and Foxglove messages, and what they are: raw or rectified, mosaics, depth."""

import re
from typing import Any

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from foredrive.data.images import decoded, grey_to_rgb
from foredrive.errors import InputError

_TO_RGB = {
    "rgb8": None,
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "8UC3": cv2.COLOR_BGR2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
    "8UC1": cv2.COLOR_GRAY2RGB,
    "mono16": None,
    "16UC1": None,
    "rgb16": None,
    "bgr16": cv2.COLOR_BGR2RGB,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
    "bayer_rggb16": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr16": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg16": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg16": cv2.COLOR_BayerGRBG2RGB,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "yuyv": cv2.COLOR_YUV2RGB_YUYV,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUYV,
}
"""OpenCV's conversions of ROS' and Foxglove's encodings. A Bayer pattern is named by its first two rows."""
_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "rgb16": 3, "bgr16": 3}
_PAIRED = ("uyvy", "yuv422", "yuyv", "yuv422_yuy2")
_DEPTH = re.compile(r"depth|disparity|range_image", re.IGNORECASE)
_RECTIFIED = re.compile(r"(^|_)(rect|rectified)(_|$)", re.IGNORECASE)


def is_rectified(topic: str) -> bool:
    """Return whether images are rectified, as the name of their topic says: image_rect, rect_color, …"""
    return any(_RECTIFIED.search(part) for part in topic.split("/"))


def depth_fault(topic: str, message: Any) -> str | None:
    """Return why images are depth and none of a camera, or None if they may be a camera's.

    16 bits alone are no depth: thermal cameras have them too.
    """
    source = _encoding(message)
    if source.upper() == "32FC1" or "compresseddepth" in str(getattr(message, "format", "")).lower():
        return "depth, not images of a camera"
    if source in ("16UC1", "mono16") and _DEPTH.search(topic):
        return "depth, not images of a camera"
    return None


def _encoding(message: Any) -> str:
    """Return the encoding of the source: the first word of the format of compressed images."""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    return str(message.format).partition(";")[0].strip()


def read_image(message: Any, value_range: tuple[float, float] | None = None) -> UInt8[np.ndarray, "H W 3"]:
    """Return an image as RGB.

    Args:
        message: an Image, CompressedImage or RawImage.
        value_range: values of an image with 16 bits that become 0 and 255.

    Raises:
        InputError: the encoding is not known, the data do not fit it, or 16 bits have no range.
    """
    pixels = read_pixels(message)
    if pixels.dtype == np.uint8:
        return pixels
    if value_range is None:
        raise InputError(
            f"an image of 16 bits ({pixels.min()} to {pixels.max()}); the YAML needs its `value_range`"
        )
    if pixels.ndim == 2:
        return grey_to_rgb(pixels, value_range)
    return np.stack([grey_to_rgb(channel, value_range)[..., 0] for channel in np.moveaxis(pixels, -1, 0)], -1)


def read_pixels(message: Any) -> Shaped[np.ndarray, "H W *channels"]:
    """Return an image as uint8 RGB [H, W, 3]. One of 16 bits keeps them, and is [H, W] if it is grey.

    Raises:
        InputError: the encoding is not known, the data do not fit it, or it is depth.
    """
    if depth_fault("", message) is not None:
        raise InputError(f"images of {_encoding(message)} are depth, not those of a camera")
    if not hasattr(message, "encoding"):
        return _compressed(message)
    encoding = message.encoding
    if encoding not in _TO_RGB:
        raise InputError(f"images of encoding {encoding!r} are not read; there are: {', '.join(_TO_RGB)}")
    step, height, width = int(message.step), int(message.height), int(message.width)
    depth = np.dtype("u2" if "16" in encoding else "u1")
    channels = 2 if encoding in _PAIRED else _CHANNELS.get(encoding, 1)
    data = np.frombuffer(bytes(message.data), np.uint8)
    # Rows may be padded to a step, but never shorter than their pixels; the last one may lack its padding
    row = width * channels * depth.itemsize
    size = (height - 1) * step + row
    if not size <= data.size <= height * step or row > step or not row or not height:
        raise InputError(f"an image of {height} x {width} px in rows of {step} bytes has {data.size} bytes")
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1))
    pixels = np.ascontiguousarray(rows)
    if depth.itemsize == 2:
        # The byte order is that of the message
        big = bool(getattr(message, "is_bigendian", 0))
        pixels = pixels.view(depth.newbyteorder(">" if big else "<")).astype(np.uint16)
    pixels = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    code = _TO_RGB[encoding]
    return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code))


def _compressed(message: Any) -> Shaped[np.ndarray, "H W *channels"]:
    """Return the pixels of a compressed image.

    The format is that of image_transport: the encoding of the source, and behind "compressed" that of the
    data. Where a mosaic was compressed without a change, the data are grey.
    """
    source = _encoding(message)
    try:
        pixels = decoded(bytes(message.data))
    except InputError as error:
        raise InputError(f"an image of the format {str(message.format)!r}: {error}") from error
    code = _TO_RGB.get(source) if source.startswith("bayer_") else None
    grey = pixels.ndim == 2 or bool((pixels[..., :1] == pixels[..., 1:]).all())
    target = str(message.format).rpartition("compressed")[2].strip()
    if code is None:
        if source.startswith("bayer_") and grey:
            raise InputError(f"mosaics of the pattern {source!r} are not read")
        return pixels
    # The transport may have made colours of the mosaic
    if not grey or target in ("bgr8", "rgb8"):
        return pixels
    mosaic = pixels if pixels.ndim == 2 else pixels[..., 0]
    mosaic = np.ascontiguousarray(mosaic if mosaic.dtype == np.uint8 else mosaic.astype(np.uint16))
    return np.asarray(cv2.cvtColor(mosaic, code))
