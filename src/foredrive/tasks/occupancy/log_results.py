"""Predicted semantic voxels of frames of 123D logs: written, read, and scored by the recordings of the logs.

A folder holds LOG@T_US.npz (a log's name may hold a folder) with `semantics` and perhaps `flow`, in the order
X Y Z as Occ3D's and OpenOcc's, and grid.json, which states the names of the classes, the grid in the ego
frame, and the cameras whose lines of sight make the camera mask. Without grid.json the grid is Occ3D's, and
all cameras of the log count.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from foredrive.data.cameras import find_camera, pinhole_cameras
from foredrive.data.truth.rays import read_rays
from foredrive.data.truth.semantic_labels import read_semantics
from foredrive.engine.summary import Figures, write_json
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.scene import VoxelSpec
from foredrive.scene.semantics import VOXEL_CLASSES, Taxonomy
from foredrive.tasks.files.frames_of_results import log_frames
from foredrive.tasks.files.plain_files import read_plain
from foredrive.tasks.occupancy.arrays import array_names, read_labels, read_velocities
from foredrive.tasks.occupancy.files import PREDICTED_NAMES
from foredrive.tasks.occupancy.of_logs import LogVoxelCounts
from foredrive.tasks.occupancy.protocols import GRID
from foredrive.tasks.occupancy.turned import TurnedVoxels

GRID_FILE = "grid.json"


@dataclass(frozen=True)
class VoxelGridOfResults:
    """The meaning of the arrays in a folder: their grid and their classes."""

    taxonomy: Taxonomy
    spec: VoxelSpec
    cameras: tuple[str, ...] | None
    """Names of the cameras of the camera mask; None: all of the log."""


def write_grid(folder: Path, grid: VoxelGridOfResults) -> None:
    """Write the file that states the grid."""
    stated = {"classes": grid.taxonomy, **vars(grid.spec), "cameras": grid.cameras}
    write_json(folder / GRID_FILE, stated)


def write_voxels(
    path: Path,
    labels: UInt8[ndarray, "Z Y X"],
    flow_mps: Float[ndarray, "2 Z Y X"] | None,
    taxonomy: Taxonomy,
) -> None:
    # Labels Z Y X in memory, X Y Z in the file
    """Write the voxels of one frame. Free voxels stand still, as in figures."""
    semantics = np.ascontiguousarray(labels.T)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        if flow_mps is None:
            np.savez_compressed(file, semantics=semantics)
            return
        # The last class is free space
        occupied = labels != len(VOXEL_CLASSES[taxonomy]) - 1
        flow = np.where(occupied, flow_mps, 0.0).astype(np.float32).T
        np.savez_compressed(file, semantics=semantics, flow=np.ascontiguousarray(flow))


def holds_logs(folder: Path) -> bool:
    """Return whether a folder holds 123D logs, at any depth, or is one."""
    return folder.is_dir() and next(folder.rglob("sync.arrow"), None) is not None


def score_against_logs(results: Path, truth: Path, on_frame: Callable[[], None] = lambda: None) -> Figures:
    """Return the figures of all frames of a folder of results, as an evaluation counts them.

    Raises:
        InputError: a frame is not in the logs or has no recorded voxels, or a file is wrong.
    """
    # Names of frames are paths relative to the folder, as names of logs may hold folders
    files = {path.relative_to(results).as_posix()[: -len(".npz")]: path for path in results.rglob("*.npz")}
    if not files:
        raise InputError(f"{results}: holds no LOG@T_US.npz")
    grid = read_grid(results)
    counts = LogVoxelCounts(grid.taxonomy, grid.spec)
    turned = TurnedVoxels(results, free=len(VOXEL_CLASSES[grid.taxonomy]) - 1)
    without_velocity = 0
    for frame in log_frames(truth, files, results):
        labels, flow_mps = _read(files[frame.name], grid)
        # The camera mask depends on which cameras the model saw
        cameras = pinhole_cameras(frame.log)
        named = (
            cameras if grid.cameras is None else {name: find_camera(cameras, name) for name in grid.cameras}
        )
        pinholes = [camera for camera in named.values() if camera is not None]
        true = read_semantics(frame.log, frame.frame, grid.spec, grid.taxonomy, pinholes)
        if not bool(true.known.any()):
            raise InputError(f"{frame.log.path.folder} has no recorded voxels to judge frame {frame.name} by")
        counts.add(labels, flow_mps, true, read_rays(frame.log, frame.frame, grid.spec))
        turned.add(labels, true.index.numpy(), (true.known & true.camera_mask).numpy())
        without_velocity += flow_mps is None
        on_frame()
    turned.tell()
    figures: Figures = {"data_set": grid.taxonomy, "frames": len(files)}
    figures["frames_without_velocity"] = without_velocity
    return figures | {f"occupancy.{key}": value for key, value in counts.figures().items()}


def read_grid(folder: Path) -> VoxelGridOfResults:
    """Read what the arrays of a folder mean.

    Raises:
        InputError: an entry is wrong. The message names it.
    """
    # Without a description, the grid is Occ3D's
    path = folder / GRID_FILE
    if not path.is_file():
        return VoxelGridOfResults("occ3d", GRID, None)
    stated = read_plain(path)
    if not isinstance(stated, dict):
        raise InputError(f"{path}: not an object")
    if stated.get("classes") not in VOXEL_CLASSES:
        names = ", ".join(VOXEL_CLASSES)
        raise InputError(f"{path}: the classes {stated.get('classes')!r} are none of {names}")
    lower_m, shape = (_three(stated, name, path) for name in ("lower_m", "shape_zyx"))
    (voxel_m,) = _numbers(stated, "voxel_m", 1, path)
    if not voxel_m > 0 or not all(size > 0 and size == int(size) for size in shape):
        raise InputError(f"{path}: voxel_m and shape_zyx must be above 0, the shape in whole numbers")
    cameras = stated.get("cameras")
    if cameras is not None and not (isinstance(cameras, list) and all(isinstance(n, str) for n in cameras)):
        raise InputError(f"{path}: cameras is not a list of names")
    z, y, x = (int(size) for size in shape)
    spec = VoxelSpec(lower_m, voxel_m, (z, y, x))
    return VoxelGridOfResults(stated["classes"], spec, None if cameras is None else tuple(cameras))


def _three(stated: dict[str, Any], name: str, path: Path) -> tuple[float, float, float]:
    first, second, third = _numbers(stated, name, 3, path)
    return first, second, third


def _numbers(stated: dict[str, Any], name: str, count: int, path: Path) -> list[float]:
    value = stated.get(name)
    values: list[Any] = value if isinstance(value, list) else [value]
    if len(values) != count or not all(_is_number(entry) for entry in values):
        raise InputError(f"{path}: {name} is not {count} finite number{'s' if count > 1 else ''}")
    return [float(entry) for entry in values]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def _read(
    file: Path, grid: VoxelGridOfResults
) -> tuple[UInt8[ndarray, "Z Y X"], Float[ndarray, "2 Z Y X"] | None]:
    names = array_names(file)
    name = next((name for name in PREDICTED_NAMES if name in names), None)
    if name is None:
        raise InputError(f"{file}: has no array named {', '.join(PREDICTED_NAMES[:-1])}")
    labels = read_labels(file, name, VOXEL_CLASSES[grid.taxonomy], grid.spec)
    if "flow" not in names:
        return labels, None
    flow_mps = read_velocities(file, "flow", grid.spec)
    if not np.isfinite(flow_mps).all():
        raise InputError(f"{file}: flow: a velocity is not finite")
    return labels, np.moveaxis(flow_mps, -1, 0)
