"""Sweeps as bare 32-bit numbers, whose columns no header states."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from foredrive.data.notices import note
from foredrive.errors import InputError

KITTI = ("x", "y", "z", "intensity")
NUSCENES = (*KITTI, "ring")
_LAYOUTS = (KITTI, NUSCENES, (*NUSCENES, "time"), ("x", "y", "z"))
_MAX_M = 1000.0
"""No coordinate of a point of a vehicle's lidar is beyond it."""
_SCALES = (1.0, 255.0, 65_535.0)
"""Largest values of the usual scales of intensity."""
_MAX_RING = 255


def read_points(file: Path, columns: tuple[str, ...]) -> Float32[np.ndarray, "N C"]:
    """Return the rows of a file of float32 with the given columns.

    The columns are checked by their content: numbers of another layout would be points in wrong places.

    Raises:
        InputError: the size or the values are not those of such columns.
    """
    numbers = np.fromfile(file, dtype="<f4")
    # Another layout that fits is named in the error
    if file.stat().st_size % 4 or not _fits(numbers, columns):
        others = [layout for layout in _LAYOUTS if layout != columns and _fits(numbers, layout)]
        hint = f"; {len(others[0])} columns would fit ({' '.join(others[0])})" if others else ""
        wanted = f"{len(columns)} columns ({' '.join(columns)})"
        raise InputError(f"{file}: {file.stat().st_size} bytes that are not rows of {wanted}{hint}")
    return numbers.reshape(-1, len(columns))


def _fits(numbers: Float32[np.ndarray, "M"], columns: tuple[str, ...]) -> bool:
    """Return whether numbers can be rows of these columns."""
    if numbers.size % len(columns):
        return False
    rows = numbers.reshape(-1, len(columns))
    # The columns are judged by points with finite coordinates
    rows = rows[np.isfinite(rows[:, :3]).all(axis=-1)]  # some drivers write NaN where nothing returned
    if (np.abs(rows[:, :3]) > _MAX_M).any():
        return False
    # In a wrong layout coordinates, some of them negative, get into the other columns.
    for name, values in zip(columns[3:], rows.T[3:], strict=True):
        whole = name != "ring" or bool((values == np.round(values)).all())
        high = {"intensity": _SCALES[-1], "ring": _MAX_RING, "time": np.inf}[name]
        if not np.isfinite(values).all() or (values < 0).any() or (values > high).any() or not whole:
            return False
    return True


class IntensityScale:
    """Intensities of one log between 0 and 1. The scale is that of the largest value in the first sweep."""

    def __init__(self, subject: str) -> None:
        self._subject = subject
        self._scale: float | None = None

    def __call__(self, values: Float32[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
        """Return intensities from 0 to 1. A scale other than 1 is noted.

        Raises:
            InputError: a later sweep exceeds the scale of the first.
        """
        largest = float(values.max(initial=0.0))
        # The smallest usual scale that holds the first sweep
        if self._scale is None:
            self._scale = next((scale for scale in _SCALES if largest <= scale), largest)
            if self._scale != 1.0:
                note(self._subject, f"intensities up to {largest:g} were divided by {self._scale:g}")
        if largest > self._scale:
            limit = f"those of the first sweep end at {self._scale:g}"
            raise InputError(f"{self._subject}: an intensity of {largest:g}, but {limit}")
        return values.astype(np.float64) / self._scale
