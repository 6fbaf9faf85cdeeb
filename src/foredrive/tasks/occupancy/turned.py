"""Whether predicted voxels have the axes of the truth."""

from pathlib import Path

from jaxtyping import Bool, UInt8
from numpy import ndarray

from foredrive.tasks.files.turned_axes import MAX_FRAMES, TURNS, Turn, tell_if_turned

_AS_GIVEN = Turn(False, False, False)


class TurnedVoxels:
    """Agreement of the first frames with the truth, under each change of the axes.

    Args:
        path: of the results, for the message.
        free: class of free voxels.
    """

    def __init__(self, path: Path, free: int) -> None:
        self._path, self._free, self._frames = path, free, 0
        self._hits, self._either = (dict.fromkeys((_AS_GIVEN, *TURNS), 0) for _ in range(2))

    def add(
        self,
        predicted: UInt8[ndarray, "Z Y X"],
        true: UInt8[ndarray, "Z Y X"],
        known: Bool[ndarray, "Z Y X"],
    ) -> None:
        """Add a frame; only `known` voxels of the truth are compared."""
        if self._frames == MAX_FRAMES or predicted.shape[1] != predicted.shape[2]:
            return
        self._frames += 1
        for turn in self._hits:
            turned = turn.of_grid(predicted)
            occupied = known & ((turned != self._free) | (true != self._free))
            self._either[turn] += int(occupied.sum())
            self._hits[turn] += int((occupied & (turned == true)).sum())

    def tell(self) -> None:
        """Say in one line if another choice of axes agrees far better."""
        share = {turn: hits / max(self._either[turn], 1) for turn, hits in self._hits.items()}
        tell_if_turned(self._path, "the share of equal occupied voxels", share.pop(_AS_GIVEN), share)
