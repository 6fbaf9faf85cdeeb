"""Tracks in KITTI's text format, scored on image boxes as KITTI's benchmark does.

A folder has a file for each sequence. A line: frame, track, type, truncation, occlusion, alpha, image box
(4), height, width, length, x, y, z, rotation, and for results a score. Results hold all classes together.

Source of the rules: trackeval 1.3.0, datasets/kitti_2d_box.py. HOTA is that of trackeval. CLEAR MOT is that
of motmetrics, as everywhere here: it remembers a track over any gap, trackeval's for one frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from numpy import ndarray
from scipy.optimize import linear_sum_assignment

from foredrive.engine.summary import Figures
from foredrive.errors import InputError
from foredrive.tasks.detection.kitti_labels import KITTI_TYPES, check_type, result_files
from foredrive.tasks.files.plain_files import MAX_NUMBER, tell_left_out
from foredrive.tasks.objects.matching import overlaps
from foredrive.tasks.tracking.clear import Candidates, TrackRows, clear_mot
from foredrive.tasks.tracking.hota import hota

CLASSES: Final = {"car": "van", "pedestrian": "person"}
"""Classes that are judged, each with the class that is neither demanded nor forbidden."""
MIN_OVERLAP, MIN_HEIGHT_PX, MAX_OCCLUSION, MAX_TRUNCATION = 0.5, 25.0, 2, 0
_EPS = np.finfo(float).eps
_RESULT_FIELDS = 18


@dataclass(frozen=True)
class KittiBoxes:
    """Boxes of one sequence, one a row."""

    frame: Int[ndarray, "n"]
    track: Int[ndarray, "n"]
    kind: Shaped[ndarray, "n"]
    """Class in lower case."""
    truncation: Float[ndarray, "n"]
    occlusion: Float[ndarray, "n"]
    corners: Float[ndarray, "n 4"]
    """Left, top, right, bottom, px."""

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, which: Shaped[ndarray, "_"] | slice) -> "KittiBoxes":
        return KittiBoxes(**{name: column[which] for name, column in vars(self).items()})


def score_kitti_tracks(folder: Path, truth: Path) -> Figures:
    """Return HOTA and CLEAR MOT of each class that the truth has, over all of its sequences.

    Raises:
        InputError: a line is wrong, or a sequence has no truth. The message names the first.
    """
    folder, files = result_files(folder, truth, "sequence")
    paths = sorted(truth.glob("*.txt"))
    pairs = []
    for path in paths:
        true = read_sequence(path, _RESULT_FIELDS - 1)
        for n, kind in enumerate(true.kind.tolist(), 1):
            check_type(kind, f"{path}: box {n}")
        pairs.append(
            (true, read_sequence(folder / path.name, _RESULT_FIELDS) if path.name in files else true[:0])
        )
    given = sum(len(predicted) for _, predicted in pairs)
    judged = [name for name in CLASSES if any((true.kind == name).any() for true, _ in pairs)]
    unjudged = [name for name in CLASSES if name not in judged]
    # Types that KITTI does not know are left out
    pairs = [(true, predicted[np.isin(predicted.kind, KITTI_TYPES)]) for true, predicted in pairs]
    others = given - sum(len(predicted) for _, predicted in pairs)
    absent = sum(int(np.isin(predicted.kind, unjudged).sum()) for _, predicted in pairs)
    tell_left_out(
        folder, {"boxes of other classes": others, "boxes of classes that the truth lacks": absent}, given
    )
    figures: Figures = {
        "data_set": "kitti",
        "scenes": len(paths),
        "scenes_without_results": len(paths) - len(files),
        "boxes_of_other_classes_left_out": others,
    }
    for name in judged:
        figures |= {f"tracking.kitti.{name}.{key}": value for key, value in _score_class(pairs, name).items()}
    return figures


def read_sequence(path: Path, fields: int) -> KittiBoxes:
    """Read the boxes of one sequence.

    Raises:
        InputError: a line is wrong, or a track has two boxes in a frame.
    """
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not text that can be read") from error
    rows, kinds, seen = [], [], set()
    for n, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        if len(words) < fields:
            raise InputError(f"{path}: line {n} has {len(words)} fields, not {fields}")
        try:
            # The type is the only word that is no number
            values = [float(word) for word in (*words[:2], *words[3:fields])]
        except ValueError as error:
            raise InputError(f"{path}: line {n} has something that is not a number") from error
        if not all(abs(value) <= MAX_NUMBER for value in values):
            raise InputError(f"{path}: line {n} has a number that is not finite, or beyond {MAX_NUMBER:g}")
        kind = words[2].lower()
        # A track has one box in a frame; `DontCare` regions may repeat their number
        if kind != "dontcare" and (kind, *values[:2]) in seen:
            raise InputError(f"{path}: line {n} has the track {words[1]} a second time in frame {words[0]}")
        seen.add((kind, *values[:2]))
        rows.append(values)
        kinds.append(kind)
    table = np.array(rows, dtype=np.float64).reshape(-1, fields - 1)
    frame, track = table[:, :2].astype(np.int64).T
    boxes = KittiBoxes(frame, track, np.array(kinds, dtype="U32"), table[:, 2], table[:, 3], table[:, 5:9])
    return boxes[np.argsort(frame, kind="stable")]


def counted_boxes(true: KittiBoxes, predicted: KittiBoxes, name: str) -> tuple[KittiBoxes, KittiBoxes]:
    """Return the true boxes of a class that must be found, and the found boxes that count for or against.

    Truth that is truncated, hardly visible or of the neighbouring class need not be found. What is matched
    with it does not count; nor what is matched with nothing and low, or mostly in a `DontCare` region.
    """
    ignored = true[true.kind == "dontcare"]
    true, predicted = true[np.isin(true.kind, (name, CLASSES[name]))], predicted[predicted.kind == name]
    # Boxes that must be found: of the class, not truncated, visible enough
    must = (true.kind == name) & (true.occlusion <= MAX_OCCLUSION) & (true.truncation <= MAX_TRUNCATION)
    kept = np.ones(len(predicted), bool)
    for frame in np.unique(predicted.frame):
        columns, rows = np.flatnonzero(predicted.frame == frame), np.flatnonzero(true.frame == frame)
        # The largest total overlap, of pairs that overlap enough
        overlap = overlaps(true.corners[rows], predicted.corners[columns])
        overlap[overlap < MIN_OVERLAP - _EPS] = 0.0
        row, column = linear_sum_assignment(overlap, maximize=True)
        hit = overlap[row, column] > 0
        row, column = row[hit], column[hit]
        # What is matched with a box that need not be found does not count
        kept[columns[column]] = must[rows[row]]
        # Unmatched detections that are low, or mostly in an ignored region, do not count either
        alone = np.delete(columns, column)
        corners, regions = predicted.corners[alone], ignored.corners[ignored.frame == frame]
        low = corners[:, 3] - corners[:, 1] <= MIN_HEIGHT_PX + _EPS
        kept[alone] = ~(low | _mostly_inside(corners, regions))
    return true[must], predicted[kept]


def _mostly_inside(corners: Float[ndarray, "n 4"], regions: Float[ndarray, "m 4"]) -> Bool[ndarray, "n"]:
    """Return whether more than half of each box lies in one of the regions."""
    # Intersection with each region over the area of the box, as a region may be much larger
    upper = np.minimum(corners[:, None, 2:], regions[:, 2:])
    shared = np.clip(upper - np.maximum(corners[:, None, :2], regions[:, :2]), 0.0, None).prod(-1)
    area = (corners[:, 2:] - corners[:, :2]).prod(-1)
    return (shared > (0.5 + _EPS) * area[:, None]).any(1)


def _score_class(pairs: Sequence[tuple[KittiBoxes, KittiBoxes]], name: str) -> dict[str, float | int | None]:
    sides: tuple[list[KittiBoxes], list[KittiBoxes]] = ([], [])
    for pair in pairs:
        for side, boxes in zip(sides, counted_boxes(*pair, name), strict=True):
            side.append(boxes)
    # Frames and tracks of a sequence are shifted, so that those of two sequences differ
    frames = 1 + max(int(boxes.frame.max(initial=0)) for side in sides for boxes in side)
    (true, a), (predicted, b) = (_joined(side, frames) for side in sides)
    rows, columns, values = [], [], []
    for frame in np.unique(true.frame):
        row, column = (np.flatnonzero(side.frame == frame) for side in (true, predicted))
        overlap = overlaps(a[row], b[column])
        # Pairs that overlap at all are HOTA's candidates
        i, j = np.nonzero(overlap)
        rows.append(row[i])
        columns.append(column[j])
        values.append(overlap[i, j])
    zero = np.zeros(0, np.int64)
    row, column = (np.concatenate([zero, *pair]) for pair in (rows, columns))
    similar = Candidates(row, column, np.concatenate([np.zeros(0), *values]))
    near = similar.value >= MIN_OVERLAP - _EPS
    # CLEAR MOT needs an overlap of a half; the distance is one less the overlap
    close = Candidates(similar.true_row[near], similar.found_row[near], 1 - similar.value[near])
    counts = clear_mot(true, predicted, close)[1]
    clear = {"mota": counts.mota, "motp_overlap": 1 - counts.motp, "recall": counts.recall}
    return {
        **hota(true, predicted, similar).figures(),
        **{key: None if np.isnan(value) else value for key, value in clear.items()},
        "gt": counts.true,
        "tp": counts.matches,
        "fp": counts.false,
        "fn": counts.misses,
        "ids": counts.switches,
        "frag": counts.fragments,
        "mt": counts.mostly_tracked,
        "ml": counts.mostly_lost,
    }


def _joined(sequences: Sequence[KittiBoxes], frames: int) -> tuple[TrackRows, Float[ndarray, "n 4"]]:
    """Return the rows of all sequences, each with frames and tracks of its own, and the image boxes."""
    tracks = 1 + max(int(boxes.track.max(initial=0)) for boxes in sequences)
    rows = TrackRows(
        np.concatenate([n * frames + boxes.frame for n, boxes in enumerate(sequences)]),
        np.concatenate([n * tracks + boxes.track for n, boxes in enumerate(sequences)]),
    )
    return rows, np.concatenate([boxes.corners for boxes in sequences])
