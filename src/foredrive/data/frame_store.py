"""All cameras and boxes of a log at one frame, with a disk cache."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
import torch
from jaxtyping import Bool, UInt8
from py123d.datatypes import PinholeCameraMetadata
from torch import Tensor

from foredrive.data.boxes import no_boxes, read_boxes, with_counted_points
from foredrive.data.cameras import read_camera
from foredrive.data.disk_cache import DiskCache
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.scene import Boxes, CameraRig
from foredrive.scene.boxes import UNKNOWN
from foredrive.scene.record import Record

FRAME_VERSION = 2
"""Version in every cache key. Increase it when the images, rigs or boxes change."""


@dataclass(frozen=True)
class FrameData(Record):
    """Images, rig and boxes of one frame."""

    images: UInt8[Tensor, "*b C 3 H W"]
    image_valid: Bool[Tensor, "*b C"]
    rig: CameraRig
    """A camera that the log lacks has identity matrices."""
    boxes: Boxes
    boxes_valid: Bool[Tensor, "*b"]
    """True if the frame is annotated."""


class FrameStore:
    """A reader of frames with a cache of those whose images were downsized.

    One file holds a whole frame, and reading it opens no table of the log, so frames of many logs in random
    order are read as fast as those of one.

    Args:
        cache_dir: folder of the cache. None disables it.
        image_hw: height and width of the images.
        names: C camera names.
    """

    def __init__(self, cache_dir: Path | None, image_hw: tuple[int, int], names: tuple[str, ...]) -> None:
        self._cache = DiskCache(None if cache_dir is None else Path(cache_dir) / "frames", "frame")
        self._keys: dict[Path, str] = {}
        self.image_hw, self.names = image_hw, names

    def read(
        self,
        log: Log,
        frame: int,
        cameras: Sequence[PinholeCameraMetadata | None],
        with_images: bool = True,
        with_points: bool = True,
    ) -> FrameData:
        """Read one frame.

        Args:
            log: the log.
            frame: its frame.
            cameras: the log's own cameras, in the order of `names`; None for a missing one.
            with_images: read the images.
            with_points: count the lidar points in boxes where the log does not have the numbers.

        Raises:
            InputError: an image, a pose or the boxes cannot be read.
        """
        present = [camera for camera in cameras if camera is not None]
        small = self.image_hw[0] * self.image_hw[1]
        shrinks = any(camera.width * camera.height > small for camera in present)
        if not (with_images and with_points and shrinks):
            return self._read(log, frame, cameras, with_images, with_points)
        return self._cache.get(
            (self._key(log, present), frame),
            lambda: self._read(log, frame, cameras, with_images, with_points),
            lambda data: safetensors.torch.save(_flat(data)),
            self._decode,
        )

    def _read(
        self,
        log: Log,
        frame: int,
        cameras: Sequence[PinholeCameraMetadata | None],
        with_images: bool,
        with_points: bool,
    ) -> FrameData:
        count = len(self.names)
        images = torch.zeros(count, 3, *self.image_hw, dtype=torch.uint8)
        image_valid = torch.zeros(count, dtype=torch.bool)
        K, T_ego_cam = torch.eye(3).repeat(count, 1, 1), torch.eye(4).repeat(count, 1, 1)
        dist, readout_s, exposed_dt_s = torch.zeros(count, 5), torch.zeros(count), torch.zeros(count)
        for c, metadata in enumerate(cameras):
            if metadata is None:
                continue
            camera = read_camera(log, frame, metadata, self.image_hw, with_images)
            K[c], T_ego_cam[c], dist[c] = camera.K, camera.T_ego_cam, camera.dist
            readout_s[c], exposed_dt_s[c] = camera.readout_s, camera.exposed_dt_s
            if camera.image is not None:
                images[c], image_valid[c] = camera.image, True
        rig = CameraRig(K, T_ego_cam, dist, readout_s, self.names, self.image_hw, exposed_dt_s)
        boxes = _counted_boxes(log, frame) if with_points else read_boxes(log, frame)
        annotated = torch.tensor(boxes is not None)
        return FrameData(images, image_valid, rig, no_boxes() if boxes is None else boxes, annotated)

    def _key(self, log: Log, cameras: Sequence[PinholeCameraMetadata]) -> str:
        """Return what all frames of a log depend on; its files are looked at once."""
        folder = log.path.folder
        if folder not in self._keys:
            files = [log.file(camera.modality_key) for camera in cameras]
            sources = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
            self._keys[folder] = repr((FRAME_VERSION, log.fingerprint, sources, self.names, self.image_hw))
        return self._keys[folder]

    def _decode(self, data: bytes) -> FrameData:
        tensors = safetensors.torch.load(data)

        def fields(part: str) -> dict[str, Tensor]:
            return {name.removeprefix(part): t for name, t in tensors.items() if name.startswith(part)}

        return FrameData(
            images=tensors["images"],
            image_valid=tensors["image_valid"],
            rig=CameraRig(names=self.names, size_hw=self.image_hw, **fields("rig.")),
            boxes=Boxes(**fields("boxes.")),
            boxes_valid=tensors["boxes_valid"],
        )


def _counted_boxes(log: Log, frame: int) -> Boxes | None:
    """Read the boxes, with their lidar returns counted if the log has a sweep but not the numbers."""
    boxes = read_boxes(log, frame)
    if boxes is None or not bool((boxes.num_points == UNKNOWN).any()):
        return boxes
    read = read_sweep(log, frame)
    return boxes if read is None else with_counted_points(boxes, read[0])


def _flat(data: FrameData) -> dict[str, Tensor]:
    """Return the tensors of a frame by name; those of nested records have a dotted one."""
    flat: dict[str, Tensor] = {}
    for field in dataclasses.fields(data):
        value = getattr(data, field.name)
        entries = (
            {field.name: value}
            if isinstance(value, Tensor)
            else {
                f"{field.name}.{name}": entry
                for name, entry in vars(value).items()
                if isinstance(entry, Tensor)
            }
        )
        flat |= {name: entry.contiguous() for name, entry in entries.items()}
    return flat
