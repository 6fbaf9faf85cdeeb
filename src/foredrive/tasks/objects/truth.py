"""Objects of a results file and of its ground truth, for detection and tracking."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from foredrive.engine.summary import Figures
from foredrive.errors import InputError
from foredrive.scene.boxes import UNKNOWN
from foredrive.tasks.objects.object_rows import Frames, ObjectRows

RACK = "static_object.bicycle_rack"
"""Name of the objects in which bicycles and motorcycles are not counted."""


@dataclass(frozen=True)
class ObjectTruth:
    """The ground truth of some frames."""

    names: Sequence[str]
    """Name of each frame: a sample token, or LOG@T_US."""
    boxes: ObjectRows
    racks: ObjectRows
    frames: Frames
    ego: Float[ndarray, "F 2"]
    """Place of the ego vehicle over ground, m; NaN: unknown."""
    lacks: frozenset[str] = frozenset()
    """What the source has for no box: "attribute", "velocity", "num_points", "range"."""


@dataclass(frozen=True)
class FoundObjects:
    """The objects of a results file, on the frames of a truth."""

    boxes: ObjectRows
    frames_without_results: int
    """Number of frames of the truth that the file does not list."""


class BoxNames(Sequence[str]):
    """Names of boxes for messages, put together when one is needed: the file, the frame, the number there."""

    def __init__(self, path: object, frames: Mapping[str, Sequence[object]]) -> None:
        self._path, self._frames = path, list(frames)
        self._start = np.cumsum([0, *(len(boxes) for boxes in frames.values())])

    def __len__(self) -> int:
        return int(self._start[-1])

    @overload
    def __getitem__(self, index: int | np.integer) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> list[str]: ...
    def __getitem__(self, index: int | np.integer | slice) -> str | list[str]:
        if isinstance(index, slice):
            return [self[n] for n in range(*index.indices(len(self)))]
        if not 0 <= index < len(self):
            raise IndexError(index)
        # The last start that is not behind the index
        frame = int(np.searchsorted(self._start, index, side="right")) - 1
        return f"{self._path}: frame {self._frames[frame]}, box {index - self._start[frame]}"


def number_names(names: Iterable[str]) -> Int[ndarray, "n"]:
    """Return a number for each name, in the order in which names first appear."""
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(name, len(numbers)) for name in names], dtype=np.int64)


def check_tracks(boxes: ObjectRows, identities: Sequence[str], names: Sequence[str]) -> None:
    """Refuse a track with two boxes in one frame.

    Raises:
        InputError: the message names the second one.
    """
    order = np.lexsort((np.arange(len(boxes)), boxes.track, boxes.frame))
    again = (np.diff(boxes.frame[order]) == 0) & (np.diff(boxes.track[order]) == 0)
    if again.any():
        row = int(order[1:][again].min())
        raise InputError(f"{names[row]} has the tracking_id {identities[row]} of another box of its frame")


def lacking(boxes: ObjectRows) -> frozenset[str]:
    """Return the names of the columns in which no box has a value."""
    columns = {
        "velocity": np.isfinite(boxes.velocity).all(1),
        "attribute": boxes.attribute != UNKNOWN,
        "num_points": boxes.num_points != UNKNOWN,
        "range": np.isfinite(boxes.from_ego).all(1),
    }
    return frozenset(name for name, column in columns.items() if len(boxes) and not column.any())


def count_objects(predicted: FoundObjects, truth: ObjectTruth) -> Figures:
    """Return how many frames and objects are judged, and what the truth lacks."""
    return {
        "frames_counted": len(truth.names),
        "scenes": len(set(truth.frames.scene.tolist())),
        "frames_without_results": predicted.frames_without_results,
        "objects": len(truth.boxes),
        "found": len(predicted.boxes),
        "truth_lacks": ", ".join(sorted(truth.lacks)) or None,
    }
