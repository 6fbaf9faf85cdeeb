"""Foredrive's additions to 123D's modalities.

They are beams that did not return, exact occupancy, visibility and attributes of boxes, settings, captions
and the plans of the expert. All are stored as 123D custom modalities with one row per frame. Each array is
compressed separately with zstd, so that a row can be read without its neighbours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Float64, Int
from py123d.datatypes import Timestamp
from py123d.datatypes.custom.custom_modality import CustomModality, CustomModalityMetadata

from foredrive.errors import InputError
from foredrive.scene import LidarSweep, Trajectory, VoxelSpec

LIDAR_BEAMS = "lidar_beams"
FULL_OCCUPANCY = "full_occupancy"
BOX_VISIBILITY = "box_visibility"
BOX_ATTRIBUTE = "box_attribute"
"""An `Attribute` for each box."""
SETTING = "setting"
"""The fields of `data.setting.Setting` as words and numbers, by name."""
CAPTION = "caption"
"""One text per frame."""
EXPERT_PLAN = "expert_plan"
"""The plan of the expert from the frame on."""
SIGNAL_LAMPS = "signal_lamps"
"""Middles of the lamps of traffic lights around the vehicle, by the lane that each guards."""

_ORIGIN_STEP_M = 1e-4
_DIRECTION_STEP = 1 / 32767


@dataclass(frozen=True)
class FullOccupancy:
    """All occupied voxels of a frame, observed or not, with category and velocity."""

    spec: VoxelSpec
    index_zyx: Int[np.ndarray, "K 3"]
    category: Int[np.ndarray, "K"]
    """A `Category`, or a negative number for the static world (in towns: -1 minus the `Surface`)."""
    velocity_mps: Float[np.ndarray, "K 3"]
    """Velocity over ground in the ego axes of the frame."""


def pack_beams(sweep: LidarSweep) -> dict[str, Any]:
    """Pack the beam data that 123D's lidar modality lacks: the origin of each return, and the misses.

    The resolution is 3e-5 rad for directions, 0.1 mm for origins and 1 µs for times.
    """
    returned = (sweep.valid & sweep.returned).numpy()
    missed = (sweep.valid & ~sweep.returned).numpy()
    steps = np.round(sweep.origin_ego.numpy()[returned | missed] / _ORIGIN_STEP_M).astype(np.int32)
    # A spinning lidar has few different origins after rounding, so beams store an index
    origins, which = np.unique(steps, axis=0, return_inverse=True)
    if len(origins) > np.iinfo(np.uint16).max:
        raise InputError(
            f"a lidar sweep has {len(origins)} different beam origins, at most 65535 can be stored"
        )
    which = which.reshape(-1).astype(np.uint16)
    # Origins are indexed over all valid beams, then split into returns and misses
    is_return = returned[returned | missed]
    return {
        "origin_steps": squeeze_array(origins),
        "return_origin": squeeze_array(which[is_return]),
        "miss_origin": squeeze_array(which[~is_return]),
        "miss_direction": squeeze_array(
            np.round(sweep.dir_ego.numpy()[missed] / _DIRECTION_STEP).astype(np.int16)
        ),
        "miss_range_m": squeeze_array(sweep.range_m.numpy()[missed].astype(np.float32)),
        "miss_dt_us": squeeze_array(np.round(sweep.dt_s.numpy()[missed] * 1e6).astype(np.int32)),
        "miss_beam": squeeze_array(sweep.beam.numpy()[missed].astype(np.int16)),
    }


def unpack_beams(data: dict[str, Any]) -> tuple[Float[np.ndarray, "R 3"], LidarSweep]:
    """Return the origins of the returns (m, ego frame, in the order of the lidar's points) and the misses."""
    origins = expand_array(data["origin_steps"]).reshape(-1, 3).astype(np.float32) * np.float32(
        _ORIGIN_STEP_M
    )
    direction = expand_array(data["miss_direction"]).astype(np.float32)
    # Rounded directions are normalised again
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True).clip(min=1)
    count = len(direction)
    misses = LidarSweep(
        origin_ego=torch.from_numpy(origins[expand_array(data["miss_origin"])]),
        dir_ego=torch.from_numpy(direction),
        range_m=torch.from_numpy(expand_array(data["miss_range_m"]).copy()),
        returned=torch.zeros(count, dtype=torch.bool),
        intensity=torch.zeros(count),
        dt_s=torch.from_numpy((expand_array(data["miss_dt_us"]) * 1e-6).astype(np.float32)),
        beam=torch.from_numpy(expand_array(data["miss_beam"]).astype(np.int64)),
        valid=torch.ones(count, dtype=torch.bool),
    )
    return origins[expand_array(data["return_origin"])], misses


def occupancy_metadata(spec: VoxelSpec) -> CustomModalityMetadata:
    """Return metadata of the full occupancy: the grid, constant within a log."""
    grid = {"lower_m": list(spec.lower_m), "voxel_m": spec.voxel_m, "shape_zyx": list(spec.shape_zyx)}
    return CustomModalityMetadata(FULL_OCCUPANCY, grid)


def pack_occupancy(occupancy: FullOccupancy) -> dict[str, Any]:
    """Pack occupancy as sorted sparse voxels. Velocities have half precision (5 mm/s at 10 m/s)."""
    flat = np.ravel_multi_index(tuple(occupancy.index_zyx.T), occupancy.spec.shape_zyx)
    order = np.argsort(flat, kind="stable")
    return {
        # Differences of sorted indices are small numbers, which compress well
        "voxel_step": squeeze_array(np.diff(flat[order], prepend=0).astype(np.uint32)),
        "category": squeeze_array(occupancy.category[order].astype(np.int8)),
        "velocity_mps": squeeze_array(occupancy.velocity_mps[order].astype(np.float16)),
    }


def unpack_occupancy(data: dict[str, Any], metadata: CustomModalityMetadata) -> FullOccupancy:
    """Invert `pack_occupancy`. Voxels are in the order of their flat index."""
    grid = metadata.metadata
    spec = VoxelSpec(tuple(grid["lower_m"]), grid["voxel_m"], tuple(grid["shape_zyx"]))
    flat = np.cumsum(expand_array(data["voxel_step"]), dtype=np.int64)
    return FullOccupancy(
        spec=spec,
        index_zyx=np.stack(np.unravel_index(flat, spec.shape_zyx), axis=-1),
        category=expand_array(data["category"]).astype(np.int64),
        velocity_mps=expand_array(data["velocity_mps"]).astype(np.float32),
    )


def visibility_modality(share: Sequence[float], timestamp: Timestamp) -> CustomModality:
    """Return visible shares, in the order of the frame's boxes, as a modality; NaN where not known.

    The precision is 0.0005.
    """
    data = {"visibility": squeeze_array(np.array(share, dtype=np.float16))}
    return CustomModality(data, CustomModalityMetadata(BOX_VISIBILITY), timestamp)


def unpack_visibility(data: dict[str, Any]) -> Float[np.ndarray, "M"]:
    """Return the shares of a row of `visibility_modality`."""
    return expand_array(data["visibility"]).astype(np.float32)


def attributes_modality(attribute: Sequence[int], timestamp: Timestamp) -> CustomModality:
    """Return the `Attribute`s of boxes, in the order of the frame's boxes, as a modality."""
    data = {"attribute": squeeze_array(np.array(attribute, dtype=np.int8))}
    return CustomModality(data, CustomModalityMetadata(BOX_ATTRIBUTE), timestamp)


def unpack_attributes(data: dict[str, Any]) -> Int[np.ndarray, "M"]:
    """Return the attributes of a row of `attributes_modality`."""
    return expand_array(data["attribute"]).astype(np.int64)


def pack_plan(plan: Trajectory) -> dict[str, Any]:
    """Pack a plan of one alternative, with waypoints in whole millimetres."""
    xy_mm = np.round(plan.xy[0].double().numpy() * 1e3).astype(np.int32)
    return {"xy_mm": squeeze_array(xy_mm), "yaw": squeeze_array(plan.yaw[0].numpy()), "dt_s": plan.dt_s}


def unpack_plan(data: dict[str, Any]) -> Trajectory:
    """Invert `pack_plan`. The result is unbatched."""
    xy = torch.from_numpy(expand_array(data["xy_mm"]).astype(np.float32) * np.float32(1e-3))[None]
    return Trajectory(
        xy=xy,
        yaw=torch.from_numpy(expand_array(data["yaw"]).copy())[None],
        valid=torch.ones(xy.shape[:2], dtype=torch.bool),
        log_prob=torch.zeros(1),
        dt_s=float(data["dt_s"]),
    )


def pack_lamps(lamps: Mapping[int, Float[np.ndarray, "_ 3"]]) -> dict[str, Any]:
    """Pack places in the world frame, in whole millimetres, by the map ids of lanes."""
    lane = np.repeat(np.array(list(lamps), dtype=np.int64), [len(xyz) for xyz in lamps.values()])
    xyz = np.concatenate([np.zeros((0, 3)), *lamps.values()])
    return {"lane": squeeze_array(lane), "xyz_mm": squeeze_array(np.round(xyz * 1e3).astype(np.int32))}


def unpack_lamps(data: dict[str, Any]) -> dict[int, Float64[np.ndarray, "_ 3"]]:
    """Invert `pack_lamps`."""
    lane, xyz = expand_array(data["lane"]), expand_array(data["xyz_mm"]).astype(np.float64) * 1e-3
    return {int(name): xyz[lane == name] for name in np.unique(lane)}


def squeeze_array(array: np.ndarray) -> dict[str, Any]:
    """Pack an array as zstd-compressed plain values that msgpack can store."""
    data = np.ascontiguousarray(array).tobytes()
    packed = pa.compress(data, codec="zstd", asbytes=True) if data else b""
    return {"zstd": packed, "dtype": array.dtype.str, "shape": list(array.shape)}


def expand_array(packed: dict[str, Any]) -> np.ndarray:
    """Invert `squeeze_array`. The result is read-only."""
    dtype, shape = np.dtype(packed["dtype"]), packed["shape"]
    size = dtype.itemsize * int(np.prod(shape))
    data = pa.decompress(packed["zstd"], decompressed_size=size, codec="zstd", asbytes=True) if size else b""
    return np.frombuffer(data, dtype=dtype).reshape(shape)
