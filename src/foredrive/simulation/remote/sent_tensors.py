"""Tensors as text: what `torch.save` writes, in base64, as neuro-ncap and its renderer send images."""

import base64
import io
import zipfile
from collections.abc import Mapping

import torch
from jaxtyping import UInt8
from torch import Tensor

from foredrive.errors import InputError

MAX_IMAGE_BYTES = 2**26
"""Largest image that is read, in bytes of its pixels."""


def encode_tensors(value: Tensor | Mapping[str, Tensor]) -> str:
    """Return a tensor, or a dict of tensors, as text."""
    buffer = io.BytesIO()
    torch.save(value if isinstance(value, Tensor) else dict(value), buffer)
    return base64.b64encode(buffer.getvalue()).decode()


def decode_image(text: str, max_bytes: int = MAX_IMAGE_BYTES) -> UInt8[Tensor, "H W 3"]:
    """Return an RGB image that `encode_tensors` made. No code of the text is run.

    Raises:
        InputError: the text holds something else, or a larger image.
    """
    try:
        data = base64.b64decode(text, validate=True)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:  # its members may be compressed
            size = sum(member.file_size for member in archive.infolist())
        if size > max_bytes + 2**16:
            raise InputError(f"an image may have {max_bytes:,} bytes, not {size:,}")
        image = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except InputError:
        raise
    except Exception as error:  # torch.load raises many kinds of errors
        raise InputError(
            f"an image is not a tensor in base64: {type(error).__name__}: {str(error).splitlines()[0][:200]}"
        ) from error
    if not isinstance(image, Tensor) or image.dtype != torch.uint8 or image.dim() != 3 or image.shape[2] != 3:
        told = f"{image.dtype} {tuple(image.shape)}" if isinstance(image, Tensor) else type(image).__name__
        raise InputError(f"an image has to be uint8 [height, width, 3], got {told}")
    if not 0 < image.numel() <= max_bytes:  # strides of 0 make large images of small files
        raise InputError(f"an image may have 1 to {max_bytes:,} bytes, not {image.numel():,}")
    return image.contiguous()
