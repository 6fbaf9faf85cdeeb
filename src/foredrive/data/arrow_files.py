"""Reading the Arrow files of a 123D log as arrays, with errors that name the file."""

import contextlib
import errno
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float64
from PIL import Image
from scipy.spatial.transform import Rotation

from foredrive.errors import InputError

_DAMAGED = (
    pa.ArrowException,
    ValueError,
    LookupError,
    AssertionError,
    EOFError,
    zlib.error,
    Image.DecompressionBombError,
)
REFUSES_WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


@contextlib.contextmanager
def reading(file: Path, what: str) -> Iterator[None]:
    """Convert errors while reading `what` from a file of a log into one-line `InputError`s.

    An error of a full or read-only disk while writing is not caused by the file. It is raised unchanged.
    """
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        if error.errno in REFUSES_WRITING:
            raise
        raise InputError(_said(file, what, error)) from error
    except _DAMAGED as error:
        raise InputError(_said(file, what, error)) from error


def _said(file: Path, what: str, error: Exception) -> str:
    reason = str(error).strip().splitlines()
    if isinstance(error, KeyError):
        reason = [f"{error} is unknown or missing"]
    return f"{file}: cannot read {what}: {reason[0] if reason else type(error).__name__}"


def check_whole(folder: Path) -> None:
    """Check that each file of a log is a complete Arrow file. py123d skips files that it cannot open.

    Raises:
        InputError: a file is damaged. The message names the first one.
    """
    for file in [folder / "sync.arrow", *sorted(folder.glob("*.arrow"))]:
        with reading(file, "it as an Arrow file"), pa.memory_map(str(file)) as source:
            pa.ipc.open_file(source)


def column_array(table: pa.Table, name: str) -> pa.Array:
    """Return a column as one array."""
    array = table[name].combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        return array.chunk(0) if array.num_chunks else pa.array([], type=array.type)
    return array


def fixed_lists(array: pa.Array, width: int) -> Float64[np.ndarray, "N W"]:
    """Return an array of fixed-size lists as rows. Null lists become NaN."""
    out = np.full((len(array), width), np.nan)
    present = array.is_valid().to_numpy(zero_copy_only=False)
    out[present] = array.flatten().to_numpy(zero_copy_only=False).reshape(-1, width)
    return out


def pose_matrices(pose: Float64[np.ndarray, "N 7"]) -> Float64[np.ndarray, "N 4 4"]:
    """Convert x y z qw qx qy qz into 4×4 matrices.

    A pose that is not finite, or whose quaternion is not valid, becomes NaN.
    """
    whole = np.isfinite(pose).all(-1) & (np.linalg.norm(pose[:, 3:], axis=-1) > 0.5)
    T = np.full((len(pose), 4, 4), np.nan)
    T[whole] = np.eye(4)
    T[whole, :3, :3] = Rotation.from_quat(pose[whole, 3:], scalar_first=True).as_matrix().reshape(-1, 3, 3)
    T[whole, :3, 3] = pose[whole, :3]
    return T
