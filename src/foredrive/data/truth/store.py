"""Ground truth of detection, mapping, motion and occupancy tasks at the now of a clip, with a disk cache."""

import dataclasses
import hashlib
import logging
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from py123d.common.utils.msgpack_utils import msgpack_decode_with_numpy, msgpack_encode_with_numpy
from py123d.datatypes import PinholeCameraMetadata
from torch import Tensor

from foredrive.data.logs import Log
from foredrive.data.maps import map_file
from foredrive.data.modalities import expand_array, squeeze_array
from foredrive.data.truth.affordances import read_affordances
from foredrive.data.truth.agent_futures import read_futures, read_instances
from foredrive.data.truth.map_elements import read_map_elements, read_map_raster
from foredrive.data.truth.rays import read_rays
from foredrive.data.truth.semantic_labels import read_semantics
from foredrive.files import atomic_path
from foredrive.scene import VoxelSpec
from foredrive.scene.map_elements import InstanceRaster, MapElements, MapRaster, PlaneSpec
from foredrive.scene.semantics import SemanticVoxels, Taxonomy
from foredrive.scene.task_truth import TaskTruth

TRUTH_VERSION = 1
"""Version in every cache key. Increase it when the truth changes."""

NOT_CACHED = ("rays", "affordances")
"""Parts that are read anew each time."""
UNIAD_RASTER = PlaneSpec((-51.2, -51.2), 0.512, (200, 200))
UNIAD_INSTANCES = PlaneSpec((-50.0, -50.0), 0.5, (200, 200))
"""UniAD's grids, but centred on the rear axle."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TaskTruthConfig:
    """The ground truth to read for the now of each clip. A part that is None is not read."""

    future_steps: int = 12
    """Number of steps of the agents' futures."""
    future_dt_s: float = 0.5
    """Time between the steps of the agents' futures, s."""
    elements_lw_m: tuple[float, float] | None = (60.0, 30.0)
    """Extent of the patch of map elements along x and along y, m: MapTR's by default, and (100, 50) is the
    wide one."""
    raster: PlaneSpec | None = UNIAD_RASTER
    """Grid of the map's raster layers: UniAD's by default."""
    line_px: int = 2
    """Width of lines in the raster layers, cells."""
    semantics: Taxonomy | None = "occ3d"
    """Classes of the semantic voxels, on the grid of the clip's voxels."""
    instances: PlaneSpec | None = UNIAD_INSTANCES
    """Grid of the vehicles over time: UniAD's by default, but centred on the rear axle."""
    instance_steps: int = 4
    """Number of steps of `instances` after now."""
    instance_dt_s: float = 0.5
    """Time between the steps of `instances`, s."""
    rays: bool = False
    """Read the lidar's places and the velocities of voxels, which metrics of rays need."""
    affordances: bool = False
    """Read the next light, the lead vehicle, and the road users that occupy the path over time."""


class TaskTruthStore:
    """A reader of task truth with a disk cache of most parts. The others are faster to read anew.

    The name of an entry is a hash of everything that it depends on: the log's files and its map (name, size,
    modification time), the frame's time, the cameras, the configuration, the voxel grid and `TRUTH_VERSION`.
    Entries are written atomically. Damaged entries are replaced.
    """

    def __init__(self, cache_dir: Path | None, config: TaskTruthConfig, voxels: VoxelSpec) -> None:
        self._folder = None if cache_dir is None else Path(cache_dir) / "truth"
        self.config, self.voxels = config, voxels

    def read(self, log: Log, frame: int, cameras: Sequence[PinholeCameraMetadata | None]) -> TaskTruth:
        """Read the truth at a frame, unbatched. `cameras` are those of the camera mask; None is left out.

        Raises:
            InputError: data cannot be read.
        """
        present = [camera for camera in cameras if camera is not None]
        file = self._file(log, frame, present)
        truth = None if file is None else self._read_entry(file)
        # A part of the truth comes from the cache, or is made and stored
        if truth is None:
            truth = self._make(log, frame, present)
            if file is not None:
                with atomic_path(file, durable=False) as temporary:
                    temporary.write_bytes(_encode(truth))
        futures = read_futures(log, frame, self.config.future_steps, self.config.future_dt_s)
        rays = read_rays(log, frame, self.voxels) if self.config.rays else None
        affordances = read_affordances(log, frame) if self.config.affordances else None
        return dataclasses.replace(truth, futures=futures, rays=rays, affordances=affordances)

    def _make(self, log: Log, frame: int, cameras: Sequence[PinholeCameraMetadata]) -> TaskTruth:
        made, config = TaskTruth(), self.config
        if config.elements_lw_m is not None:
            elements = read_map_elements(log, frame, config.elements_lw_m)
            made = dataclasses.replace(made, elements=elements)
        if config.raster is not None:
            raster = read_map_raster(log, frame, config.raster, config.line_px)
            made = dataclasses.replace(made, raster=raster)
        if config.semantics is not None:
            semantics = read_semantics(log, frame, self.voxels, config.semantics, cameras)
            made = dataclasses.replace(made, semantics=semantics)
        if config.instances is not None:
            instances = read_instances(
                log, frame, config.instance_steps, config.instance_dt_s, config.instances
            )
            made = dataclasses.replace(made, instances=instances)
        return made

    def _file(self, log: Log, frame: int, cameras: Sequence[PinholeCameraMetadata]) -> Path | None:
        if self._folder is None:
            return None
        # The shared map can change without the log
        shared = map_file(log)
        stat = None if shared is None else (str(shared), shared.stat().st_size, shared.stat().st_mtime_ns)
        names = [camera.modality_key for camera in cameras]
        now_us = int(log.t_us[frame])
        # Parts that are not cached do not change the entry's name
        kept = {name: value for name, value in vars(self.config).items() if name not in NOT_CACHED}
        # Everything that the entry depends on
        key = (TRUTH_VERSION, log.fingerprint, stat, now_us, names, kept, self.voxels)
        name = hashlib.blake2b(repr(key).encode(), digest_size=16).hexdigest()
        return self._folder / name[:2] / f"{name}.truth"

    def _read_entry(self, file: Path) -> TaskTruth | None:
        try:
            data = file.read_bytes()
        except FileNotFoundError:
            return None
        try:
            return self._decode(data)
        except Exception as error:  # any damaged entry can be computed again
            _log.warning("%s is damaged (%s) and is made anew", file, error)
            return None

    def _decode(self, data: bytes) -> TaskTruth:
        # The checksum finds entries that were cut off
        if zlib.crc32(data[4:]).to_bytes(4, "little") != data[:4]:
            raise ValueError("checksum")
        stored = msgpack_decode_with_numpy(data[4:])
        config = self.config
        constants: dict[str, tuple[type, dict[str, Any]]] = {
            "elements": (MapElements, {}),
            "raster": (MapRaster, {"spec": config.raster}),
            "semantics": (SemanticVoxels, {"spec": self.voxels, "taxonomy": config.semantics}),
            "instances": (InstanceRaster, {"spec": config.instances, "dt_s": config.instance_dt_s}),
        }
        records = {
            name: kind(**{field: _tensor(packed) for field, packed in stored[name].items()}, **rest)
            for name, (kind, rest) in constants.items()
            if name in stored
        }
        return TaskTruth(**records)


def _encode(truth: TaskTruth) -> bytes:
    """Encode the tensors of all parts, with a checksum in front."""
    parts = {name: vars(part) for name, part in vars(truth).items() if part is not None}
    stored = {
        name: {field: _packed(value) for field, value in part.items() if isinstance(value, Tensor)}
        for name, part in parts.items()
    }
    body: bytes = msgpack_encode_with_numpy(stored)
    return zlib.crc32(body).to_bytes(4, "little") + body


def _packed(tensor: Tensor) -> dict[str, Any]:
    """Pack a tensor; a mask as bits."""
    array = tensor.numpy()
    if array.dtype != np.bool_:
        return squeeze_array(array)
    # A mask takes an eighth as bits; its shape is stored as the last byte may be padded
    return {**squeeze_array(np.packbits(array)), "mask": list(array.shape)}


def _tensor(packed: dict[str, Any]) -> Tensor:
    array = expand_array(packed)
    if "mask" in packed:
        shape = packed["mask"]
        array = np.unpackbits(array, count=int(np.prod(shape))).astype(bool).reshape(shape)
    return torch.from_numpy(array.copy())
