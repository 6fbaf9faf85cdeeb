"""Ground truth of detection, mapping, motion and occupancy tasks at the now of a clip, with a disk cache."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from py123d.common.utils.msgpack_utils import msgpack_decode_with_numpy, msgpack_encode_with_numpy
from py123d.datatypes import PinholeCameraMetadata
from torch import Tensor

from foredrive.data.clip_config import TaskTruthConfig
from foredrive.data.disk_cache import DiskCache, map_fingerprint
from foredrive.data.logs import Log
from foredrive.data.modalities import expand_array, squeeze_array
from foredrive.data.truth.affordances import read_affordances
from foredrive.data.truth.agent_futures import read_futures, read_instances
from foredrive.data.truth.map_elements import read_map_elements, read_map_raster
from foredrive.data.truth.rays import read_rays
from foredrive.data.truth.semantic_labels import read_semantics
from foredrive.scene import VoxelSpec
from foredrive.scene.map_elements import InstanceRaster, MapElements, MapRaster
from foredrive.scene.semantics import SemanticVoxels
from foredrive.scene.task_truth import TaskTruth

TRUTH_VERSION = 1
"""Version in every cache key. Increase it when the truth changes."""

NOT_CACHED = ("rays", "affordances")
"""Parts that are read anew each time."""


class TaskTruthStore:
    """A reader of task truth with a disk cache of most parts. The others are faster to read anew."""

    def __init__(self, cache_dir: Path | None, config: TaskTruthConfig, voxels: VoxelSpec) -> None:
        self._cache = DiskCache(None if cache_dir is None else Path(cache_dir) / "truth", "truth")
        self.config, self.voxels = config, voxels

    def read(self, log: Log, frame: int, cameras: Sequence[PinholeCameraMetadata | None]) -> TaskTruth:
        """Read the truth at a frame, unbatched. `cameras` are those of the camera mask; None is left out.

        Raises:
            InputError: data cannot be read.
        """
        present = [camera for camera in cameras if camera is not None]
        truth = self._cache.get(
            self._key(log, frame, present), lambda: self._make(log, frame, present), _encode, self._decode
        )
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

    def _key(self, log: Log, frame: int, cameras: Sequence[PinholeCameraMetadata]) -> tuple[object, ...]:
        # Parts that are not cached do not change the entry's name
        kept = {name: value for name, value in vars(self.config).items() if name not in NOT_CACHED}
        names, now_us = [camera.modality_key for camera in cameras], int(log.t_us[frame])
        # The shared map can change without the log
        return (TRUTH_VERSION, log.fingerprint, map_fingerprint(log), now_us, names, kept, self.voxels)

    def _decode(self, data: bytes) -> TaskTruth:
        stored = msgpack_decode_with_numpy(data)
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
    """Encode the tensors of all parts."""
    parts = {name: vars(part) for name, part in vars(truth).items() if part is not None}
    stored = {
        name: {field: _packed(value) for field, value in part.items() if isinstance(value, Tensor)}
        for name, part in parts.items()
    }
    body: bytes = msgpack_encode_with_numpy(stored)
    return body


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
