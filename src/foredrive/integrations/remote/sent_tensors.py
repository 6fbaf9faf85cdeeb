"""Tensors as text: what `torch.save` writes, in base64, as neuro-ncap and its renderer send images."""

import base64
import io
import math
import pickle
import zipfile
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import UInt8
from torch import Tensor

from foredrive.errors import InputError

MAX_IMAGE_BYTES = 2**26
"""Largest image that is read, in bytes of its pixels."""
MAX_DESCRIPTION_BYTES = 4096
"""Largest description of a tensor; `torch.save` writes 150 bytes."""


def encode_tensors(value: Tensor | Mapping[str, Tensor]) -> str:
    """Return a tensor, or a dict of tensors, as text."""
    buffer = io.BytesIO()
    torch.save(value if isinstance(value, Tensor) else dict(value), buffer)
    return base64.b64encode(buffer.getvalue()).decode()


def decode_image(text: str, max_bytes: int = MAX_IMAGE_BYTES) -> UInt8[Tensor, "H W 3"]:
    """Return an RGB image that `encode_tensors` made. No code of the text is run.

    `torch.load(weights_only=True)` is not used: it runs no code, but makes a `bytearray` of any size.

    Raises:
        InputError: the text holds something else, or a larger image.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(base64.b64decode(text, validate=True))) as archive:
            size = sum(member.file_size for member in archive.infolist())  # they may be compressed
            if size > max_bytes + 2**16:
                raise InputError(f"an image may have {max_bytes:,} bytes, not {size:,}")
            image = _read_image(archive, max_bytes)
    except InputError:
        raise
    except Exception as error:  # a damaged pickle can raise any error
        why = next(iter(str(error).splitlines()), "")[:200]
        raise InputError(f"an image is not a tensor in base64: {type(error).__name__}: {why}") from error
    return image


class _Strided(NamedTuple):
    """A tensor as `torch.save` describes it."""

    member: str
    """Name of the file with its bytes."""
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


class _ImageUnpickler(pickle.Unpickler):
    """Reads the description of one uint8 tensor, and calls nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return lambda member, offset, size, stride, *_: _Strided(member, offset, size, stride)
        if (module, name) == ("collections", "OrderedDict"):  # hooks of gradients, of which there are none
            return lambda: None
        if module == "torch" and name.endswith("Storage"):
            return name
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, which an image does not need")

    def persistent_load(self, pid: Any) -> str:
        _, kind, member, *_ = pid
        if kind != "ByteStorage":
            raise InputError(f"an image has to be uint8 [height, width, 3], got a {kind}")
        return str(member)


def _read_image(archive: zipfile.ZipFile, max_bytes: int) -> UInt8[Tensor, "H W 3"]:
    """Read the image in an archive of `torch.save`."""
    (member_name,) = [member for member in archive.infolist() if member.filename.endswith("/data.pkl")]
    if member_name.file_size > MAX_DESCRIPTION_BYTES:
        raise InputError("an image has a description that is too long")
    image = _ImageUnpickler(io.BytesIO(archive.read(member_name))).load()
    if not isinstance(image, _Strided):
        raise InputError(f"an image has to be uint8 [height, width, 3], got {type(image).__name__}")
    if len(image.size) != 3 or len(image.stride) != 3 or image.size[2] != 3:
        raise InputError(f"an image has to be uint8 [height, width, 3], got {image.size}")
    pixels = math.prod(image.size)
    if not 0 < pixels <= max_bytes or min(*image.size, *image.stride, image.offset) < 0:
        raise InputError(f"an image may have 1 to {max_bytes:,} bytes, not {pixels:,}")
    content = bytearray(archive.read(member_name.filename.removesuffix("data.pkl") + f"data/{image.member}"))
    last = image.offset + sum((size - 1) * stride for size, stride in zip(*image[2:], strict=True))
    if last >= len(content):
        raise InputError(f"an image has {len(content):,} bytes, and describes {last + 1:,}")
    whole = torch.frombuffer(content, dtype=torch.uint8)
    return whole.as_strided(image.size, image.stride, image.offset).clone(
        memory_format=torch.contiguous_format
    )
