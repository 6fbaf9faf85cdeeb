"""Arrays of npz files of semantic voxels: checked by their headers before anything is read.

The files hold X Y Z; everything here returns Z Y X. Nothing is unpickled.
"""

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray
from numpy.lib import format as npy

from foredrive.errors import InputError
from foredrive.scene import VoxelSpec
from foredrive.tasks.occupancy.protocols import GRID


def array_names(file: Path) -> set[str]:
    """Return the names of the arrays in a file.

    Raises:
        InputError: the file cannot be read.
    """
    with _opened(file) as archive:
        return {name.removesuffix(".npy") for name in archive.namelist()}


def read_labels(
    file: Path, name: str, classes: tuple[str, ...], spec: VoxelSpec = GRID
) -> UInt8[ndarray, "Z Y X"]:
    """Read the class of each voxel.

    Raises:
        InputError: the array has another shape or type, or a class that is not among `classes`.
    """
    labels = _read(file, name, "iu", spec)
    if labels.min() < 0 or labels.max() >= len(classes):
        wrong = labels.min() if labels.min() < 0 else labels.max()
        raise InputError(f"{file}: {name}: unknown class {wrong}; there are 0 to {len(classes) - 1}")
    # X Y Z in the file, Z Y X in memory
    return np.ascontiguousarray(labels.reshape(spec.shape_zyx[::-1]).T.astype(np.uint8))


def read_mask(file: Path, name: str) -> Bool[ndarray, "Z Y X"]:
    """Read a mask of voxels: 0 is not seen."""
    return np.ascontiguousarray(_read(file, name, "biu", GRID).reshape(GRID.shape_zyx[::-1]).T != 0)


def read_velocities(file: Path, name: str, spec: VoxelSpec = GRID) -> Float32[ndarray, "Z Y X 2"]:
    """Read the velocity of each voxel, m/s. It may hold NaN."""
    flow = _read(file, name, "f", spec, per_voxel=2).reshape(*spec.shape_zyx[::-1], 2)
    return np.ascontiguousarray(flow.transpose(2, 1, 0, 3).astype(np.float32))


def _read(file: Path, name: str, kinds: str, spec: VoxelSpec, per_voxel: int = 1) -> ndarray:
    """Read one array of the grid's size, flat or of the grid's shape, with leading dimensions of 1."""
    with _opened(file) as archive:
        if f"{name}.npy" not in archive.namelist():
            raise InputError(f"{file}: has no array {name!r}")
        # The header tells shape and type before any data is read or unpacked
        with archive.open(f"{name}.npy") as stream:
            version = npy.read_magic(stream)
            header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, _, dtype = header(stream)
        shape_xyz, last = spec.shape_zyx[::-1], () if per_voxel == 1 else (per_voxel,)
        voxels = int(np.prod(shape_xyz))
        # Leading dimensions of 1 are those of a batch
        trimmed = shape
        while len(trimmed) > 1 and trimmed[0] == 1:
            trimmed = trimmed[1:]
        if trimmed not in ((*shape_xyz, *last), (voxels, *last), (voxels * per_voxel,)):
            wanted = " x ".join(map(str, (*shape_xyz, *last)))
            raise InputError(f"{file}: {name}: expected {wanted} values, got an array of shape {shape}")
        if dtype.kind not in kinds:
            raise InputError(f"{file}: {name}: values of type {dtype} cannot be used")
        with archive.open(f"{name}.npy") as stream:
            return np.asarray(npy.read_array(stream, allow_pickle=False))


@contextmanager
def _opened(file: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(file) as archive:
            yield archive
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{file}: {error.strerror or error}") from error
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, NotImplementedError, RuntimeError) as error:
        raise InputError(f"{file}: not an npz file that can be read") from error
