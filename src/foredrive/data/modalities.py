"""What Foredrive adds to 123D's modalities: beams that did not return, exact occupancy, visibility,
settings, captions, what a teacher would do.

All travel as 123D custom modalities, one row a frame; arrays are zstd-compressed one by one, so that a row
can be read without touching its neighbours.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Int
from py123d.datatypes.custom.custom_modality import CustomModalityMetadata

from foredrive.errors import InputError
from foredrive.scene import LidarSweep, Trajectory, VoxelSpec

LIDAR_BEAMS = "lidar_beams"
FULL_OCCUPANCY = "full_occupancy"
BOX_VISIBILITY = "box_visibility"
SETTING = "setting"
"""The facts of `data.setting.Setting`, words and numbers by their names."""
CAPTION = "caption"
"""One text a frame."""
TAUGHT_PLAN = "taught_plan"
"""What a teacher would do from here."""

_ORIGIN_STEP_M = 1e-4
_DIRECTION_STEP = 1 / 32767


@dataclass(frozen=True)
class FullOccupancy:
    """Every occupied voxel of a frame, seen or not, with what it holds and how that moves."""

    spec: VoxelSpec
    index_zyx: Int[np.ndarray, "K 3"]
    category: Int[np.ndarray, "K"]
    """A `Category`; below 0 for the static world (a town says what it is: -1 minus its `Surface`)."""
    velocity_mps: Float[np.ndarray, "K 3"]
    """Velocity over ground in the ego axes of the frame."""


def pack_beams(sweep: LidarSweep) -> dict[str, Any]:
    """What 123D's lidar modality has no room for: the origin of each return, and the misses.

    Directions are kept to 3e-5 rad, origins to 0.1 mm, times to 1 µs.
    """
    returned = (sweep.valid & sweep.returned).numpy()
    missed = (sweep.valid & ~sweep.returned).numpy()
    steps = np.round(sweep.origin_ego.numpy()[returned | missed] / _ORIGIN_STEP_M).astype(np.int32)
    origins, which = np.unique(steps, axis=0, return_inverse=True)
    if len(origins) > np.iinfo(np.uint16).max:
        raise InputError(
            f"a lidar sweep has {len(origins)} different beam origins, at most 65535 can be stored"
        )
    which = which.reshape(-1).astype(np.uint16)
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
    """Origins of the returns in the order of the lidar modality's points (m, ego frame), and the misses."""
    origins = expand_array(data["origin_steps"]).reshape(-1, 3).astype(np.float32) * np.float32(
        _ORIGIN_STEP_M
    )
    direction = expand_array(data["miss_direction"]).astype(np.float32)
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
    """Metadata of a log's full occupancy: the grid, the same for all of its frames."""
    grid = {"lower_m": list(spec.lower_m), "voxel_m": spec.voxel_m, "shape_zyx": list(spec.shape_zyx)}
    return CustomModalityMetadata(FULL_OCCUPANCY, grid)


def pack_occupancy(occupancy: FullOccupancy) -> dict[str, Any]:
    """Sparse voxels, sorted; velocities are kept to half precision (5 mm/s at 10 m/s)."""
    flat = np.ravel_multi_index(tuple(occupancy.index_zyx.T), occupancy.spec.shape_zyx)
    order = np.argsort(flat, kind="stable")
    return {
        "voxel_step": squeeze_array(np.diff(flat[order], prepend=0).astype(np.uint32)),
        "category": squeeze_array(occupancy.category[order].astype(np.int8)),
        "velocity_mps": squeeze_array(occupancy.velocity_mps[order].astype(np.float16)),
    }


def unpack_occupancy(data: dict[str, Any], metadata: CustomModalityMetadata) -> FullOccupancy:
    """Inverse of `pack_occupancy`; voxels come in the order of their flat index."""
    grid = metadata.metadata
    spec = VoxelSpec(tuple(grid["lower_m"]), grid["voxel_m"], tuple(grid["shape_zyx"]))
    flat = np.cumsum(expand_array(data["voxel_step"]), dtype=np.int64)
    return FullOccupancy(
        spec=spec,
        index_zyx=np.stack(np.unravel_index(flat, spec.shape_zyx), axis=-1),
        category=expand_array(data["category"]).astype(np.int64),
        velocity_mps=expand_array(data["velocity_mps"]).astype(np.float32),
    )


def pack_visibility(visibility: Float[np.ndarray, "M"]) -> dict[str, Any]:
    """Visibilities in the order of the frame's boxes, kept to .0005."""
    return {"visibility": squeeze_array(visibility.astype(np.float16))}


def unpack_visibility(data: dict[str, Any]) -> Float[np.ndarray, "M"]:
    """Inverse of `pack_visibility`."""
    return expand_array(data["visibility"]).astype(np.float32)


def pack_plan(plan: Trajectory) -> dict[str, Any]:
    """A plan of one alternative, waypoints kept to the millimetre."""
    xy_mm = np.round(plan.xy[0].double().numpy() * 1e3).astype(np.int32)
    return {"xy_mm": squeeze_array(xy_mm), "yaw": squeeze_array(plan.yaw[0].numpy()), "dt_s": plan.dt_s}


def unpack_plan(data: dict[str, Any]) -> Trajectory:
    """Inverse of `pack_plan`, unbatched."""
    xy = torch.from_numpy(expand_array(data["xy_mm"]).astype(np.float32) * np.float32(1e-3))[None]
    return Trajectory(
        xy=xy,
        yaw=torch.from_numpy(expand_array(data["yaw"]).copy())[None],
        valid=torch.ones(xy.shape[:2], dtype=torch.bool),
        log_prob=torch.zeros(1),
        dt_s=float(data["dt_s"]),
    )


def squeeze_array(array: np.ndarray) -> dict[str, Any]:
    """An array as plain values that msgpack can hold, zstd-compressed."""
    data = np.ascontiguousarray(array).tobytes()
    packed = pa.compress(data, codec="zstd", asbytes=True) if data else b""
    return {"zstd": packed, "dtype": array.dtype.str, "shape": list(array.shape)}


def expand_array(packed: dict[str, Any]) -> np.ndarray:
    """Inverse of `squeeze_array`; the result is read-only."""
    dtype, shape = np.dtype(packed["dtype"]), packed["shape"]
    size = dtype.itemsize * int(np.prod(shape))
    data = pa.decompress(packed["zstd"], decompressed_size=size, codec="zstd", asbytes=True) if size else b""
    return np.frombuffer(data, dtype=dtype).reshape(shape)
