"""Tracks of pedestrians whose figures other people published: TUD-Campus and TUD-Stadtmitte of motmetrics.

Their annotations have licences of their own, so they are not copied here.
"""

from pathlib import Path

import numpy as np
import pytest

from foredrive.tasks.objects.matching import overlaps
from foredrive.tasks.tracking.clear import Candidates, ClearCounts, TrackRows, clear_mot

pytestmark = pytest.mark.oracle
MIN_OVERLAP = 0.5


def counts_by_overlap(true: np.ndarray, found: np.ndarray) -> ClearCounts:
    """Counts of rows of frame, track, x1, y1, x2, y2, in the order of frames."""
    sides = [TrackRows(rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64)) for rows in (true, found)]
    apart = np.where(true[:, None, 0] == found[:, 0], 1 - overlaps(true[:, 2:], found[:, 2:]), np.inf)
    row, column = np.nonzero(apart <= 1 - MIN_OVERLAP)
    return clear_mot(*sides, Candidates(row, column, apart[row, column]))[1]


TUD = {
    "TUD-Campus": {
        "tracks": 8, "mostly_tracked": 1, "mostly_lost": 1, "false": 13, "misses": 150, "switches": 7,
        "fragments": 7, "mota": 0.526462, "motp": 0.277201, "recall": 0.582173, "precision": 0.941441,
    },
    "TUD-Stadtmitte": {
        "tracks": 10, "mostly_tracked": 5, "mostly_lost": 1, "false": 45, "misses": 452, "switches": 7,
        "fragments": 6, "mota": 0.564014, "motp": 0.345904, "recall": 0.608997, "precision": 0.939920,
    },
}  # fmt: skip


@pytest.mark.parametrize("name", list(TUD))
def test_pedestrians_of_tud(name: str) -> None:
    import motmetrics

    sides = []
    for file in ("gt.txt", "test.txt"):
        rows = np.loadtxt(Path(motmetrics.__file__).parent / "data" / name / file, delimiter=",")[:, :6]
        rows[:, 4:] += rows[:, 2:4]  # left, top, width, height
        sides.append(rows[np.argsort(rows[:, 0], kind="stable")])
    counts = counts_by_overlap(*sides)
    for key, value in TUD[name].items():
        assert getattr(counts, key) == pytest.approx(value, abs=1e-6), key
