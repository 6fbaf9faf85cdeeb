"""Reading the Arrow files of a 123D log as arrays, with errors that name the file."""

import contextlib
import errno
import struct
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
_ARROW_BEGIN, _ARROW_END = b"ARROW1\0\0", b"ARROW1"
_ARROW_TAIL = struct.Struct("<i6s")
"""The last bytes of an Arrow file: the size of its footer and the format's name."""
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
        arrow_schema(file)


def arrow_schema(file: Path) -> pa.Schema:
    """Return the schema of an Arrow file, and check that the file has its beginning and its end.

    pyarrow's reader of files takes five times as long, because it reads in threads of its own.

    Raises:
        InputError: the file is damaged or missing.
    """
    with reading(file, "it as an Arrow file"), pa.OSFile(str(file)) as source:
        begins = source.read(len(_ARROW_BEGIN)) == _ARROW_BEGIN
        # The end of a file is missing if its writer or its download was interrupted
        source.seek(max(source.size() - _ARROW_TAIL.size, 0))
        tail = source.read()
        if not begins or len(tail) < _ARROW_TAIL.size:
            raise ValueError("not an Arrow file")
        footer_size, magic = _ARROW_TAIL.unpack(tail)
        # The footer lies between the beginning and the tail
        room = source.size() - len(_ARROW_BEGIN) - _ARROW_TAIL.size
        if magic != _ARROW_END or not 0 < footer_size <= room:
            raise ValueError("not an Arrow file, or not the whole of it")
        source.seek(len(_ARROW_BEGIN))
        return pa.ipc.read_schema(source)


def arrow_table(file: Path) -> pa.Table:
    """Return the table of an Arrow file, which is mapped into memory as long as the table lives.

    An Arrow file contains a stream after its first bytes, which is read in this thread. py123d's cache keeps
    tables that are read again, and is slower for tables that are read once.
    """
    with pa.memory_map(str(file)) as source:
        source.seek(len(_ARROW_BEGIN))
        return pa.ipc.open_stream(source).read_all()


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
    # `flatten` leaves out null lists, so its rows are those of the present ones
    out[present] = array.flatten().to_numpy(zero_copy_only=False).reshape(-1, width)
    return out


def pose_matrices(pose: Float64[np.ndarray, "N 7"]) -> Float64[np.ndarray, "N 4 4"]:
    """Convert x y z qw qx qy qz into 4×4 matrices.

    A pose that is not finite, or whose quaternion is not valid, becomes NaN.
    """
    # A quaternion of zeros, as of a missing pose, is not valid
    whole = np.isfinite(pose).all(-1) & (np.linalg.norm(pose[:, 3:], axis=-1) > 0.5)
    T = np.full((len(pose), 4, 4), np.nan)
    T[whole] = np.eye(4)
    T[whole, :3, :3] = Rotation.from_quat(pose[whole, 3:], scalar_first=True).as_matrix().reshape(-1, 3, 3)
    T[whole, :3, 3] = pose[whole, :3]
    return T
