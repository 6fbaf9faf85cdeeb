"""Box tracks of a real drive whose figures Scalabel published.

They are in its repository (github.com/scalabel/scalabel, tests/eval/testcases/box_track), whose checkout
FOREDRIVE_SCALABEL names; without it, this file is not collected. The annotations have licences of their own,
so they are not copied here.
"""

import functools
import json
import operator
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.test_published import MIN_OVERLAP, counts_by_overlap

from foredrive.sets.assignment import best_assignment
from foredrive.tasks.objects.matching import overlaps

pytestmark = pytest.mark.oracle


def test_box_tracks_of_scalabel() -> None:
    """All classes of one drive, each followed alone; boxes in regions that are ignored are left out."""
    folder = Path(os.environ["FOREDRIVE_SCALABEL"]) / "tests/eval/testcases/box_track"
    true, found = (
        json.loads((folder / f"{name}.json").read_text())
        for name in ("track_sample_anns", "track_predictions")
    )
    classes = ("pedestrian", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle")
    each = [counts_by_overlap(*_of_class(true, found, name)) for name in classes]
    counts = functools.reduce(operator.add, each)
    assert (counts.false, counts.misses, counts.switches, counts.fragments) == (126, 942, 45, 66)
    assert (counts.mostly_tracked, counts.mostly_lost) == (62, 33)
    assert 100 * counts.mota == pytest.approx(64.20070762)
    assert 100 * (1 - counts.motp) == pytest.approx(87.16143945)
    assert 100 * each[2].mota == pytest.approx(71.27987664)


def _of_class(true: list[Any], found: list[Any], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows of one class, without found boxes that match nothing and lie in an ignored region."""
    identities: dict[str, int] = {}
    sides: tuple[list[np.ndarray], list[np.ndarray]] = ([np.zeros((0, 6))], [np.zeros((0, 6))])
    for a, b in zip(*(sorted(f, key=lambda frame: frame["frameIndex"]) for f in (true, found)), strict=True):
        kept, ignored = [], []
        for label in a["labels"] or []:
            if label["category"] == name:
                said = label.get("attributes") or {}
                (ignored if said.get("crowd") or said.get("ignored") else kept).append(label)
        every = [label for label in b["labels"] or [] if label["category"] == name]
        rows = [_rows(labels, a["frameIndex"], identities) for labels in (kept, every, ignored)]
        if ignored:
            apart = 1 - overlaps(rows[0][:, 2:], rows[1][:, 2:])
            cost = np.where(apart <= 1 - MIN_OVERLAP, apart, np.inf)
            matched = best_assignment(cost, np.full(len(cost), 1e3)).column
            lost = np.isin(np.arange(len(every)), matched, invert=True)
            rows[1] = rows[1][~(lost & (_covered(rows[1], rows[2]) > 0.5).any(1))]
        sides[0].append(rows[0]), sides[1].append(rows[1])
    return np.concatenate(sides[0]), np.concatenate(sides[1])


def _rows(labels: list[Any], frame: int, identities: dict[str, int]) -> np.ndarray:
    boxes = [
        [
            frame,
            identities.setdefault(label["id"], len(identities)),
            *(label["box2d"][k] for k in ("x1", "y1")),
        ]
        + [label["box2d"][k] + 1 for k in ("x2", "y2")]
        for label in labels
    ]
    return np.array(boxes, dtype=np.float64).reshape(-1, 6)


def _covered(boxes: np.ndarray, regions: np.ndarray) -> np.ndarray:
    """The share of each box that lies in each region."""
    low = np.maximum(boxes[:, None, 2:4], regions[:, 2:4])
    high = np.minimum(boxes[:, None, 4:], regions[:, 4:])
    area = (boxes[:, 4:] - boxes[:, 2:4]).prod(1)
    shared: np.ndarray = np.clip(high - low, 0, None).prod(-1) / area[:, None]
    return shared
