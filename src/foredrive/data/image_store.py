"""A cache of decoded and resized camera images."""

import dataclasses
import hashlib
import logging
from pathlib import Path

import numpy as np
import torch
from py123d.datatypes import PinholeCameraMetadata

from foredrive.data.cameras import CameraFrame, read_camera
from foredrive.data.logs import Log
from foredrive.files import atomic_path

IMAGE_VERSION = 1
"""Version in every cache key. Increase it when the images change."""

_log = logging.getLogger(__name__)


class ImageStore:
    """A reader of cameras with a cache. Images that were downsized are stored as uint8 [3 H W] .npy files.

    The name of an entry is a hash of the camera's file (name, size, modification time), the frame, the image
    size and `IMAGE_VERSION`. Entries are written atomically. Damaged entries are replaced.
    """

    def __init__(self, cache_dir: Path | None, image_hw: tuple[int, int]) -> None:
        self._folder = None if cache_dir is None else Path(cache_dir) / "images"
        self.image_hw = image_hw

    def camera(self, log: Log, frame: int, metadata: PinholeCameraMetadata, with_image: bool) -> CameraFrame:
        """Read one camera at one frame, as `read_camera`, with the cache."""
        shrinks = metadata.width * metadata.height > self.image_hw[0] * self.image_hw[1]
        if self._folder is None or not with_image or not shrinks:
            return read_camera(log, frame, metadata, self.image_hw, with_image)
        file = self._file(self._folder, log, frame, metadata)
        image = _read_entry(file, (3, *self.image_hw))
        if image is not None:
            camera = read_camera(log, frame, metadata, self.image_hw, with_image=False)
            return dataclasses.replace(camera, image=torch.from_numpy(image))
        camera = read_camera(log, frame, metadata, self.image_hw, with_image)
        if camera.image is not None:
            with atomic_path(file) as temporary, temporary.open("wb") as out:
                np.save(out, camera.image.numpy())
        return camera

    def _file(self, folder: Path, log: Log, frame: int, metadata: PinholeCameraMetadata) -> Path:
        source = log.file(metadata.modality_key)
        stat = source.stat()
        key = (IMAGE_VERSION, str(source), stat.st_size, stat.st_mtime_ns, frame, self.image_hw)
        name = hashlib.blake2b(repr(key).encode(), digest_size=16).hexdigest()
        return folder / name[:2] / f"{name}.npy"


def _read_entry(file: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    try:
        image = np.load(file, allow_pickle=False)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, EOFError) as error:
        _log.warning("%s is damaged (%s) and is made anew", file, error)
        return None
    return image if image.shape == shape and image.dtype == np.uint8 else None
